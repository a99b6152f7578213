"""The robot and the object, as MuJoCo compiles them."""
