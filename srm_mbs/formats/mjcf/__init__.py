"""MJCF, MuJoCo's XML format."""
