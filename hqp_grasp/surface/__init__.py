"""What is believed of the object's surface: the paper's sphere and plane, and the surface felt."""
