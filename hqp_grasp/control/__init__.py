"""From laws and limits to the next step."""
