"""Files that describe mechanisms, read and written: TOML, URDF, SDF, MJCF, Gepetto."""
