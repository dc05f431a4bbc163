"""The TOML description of a mechanism."""
