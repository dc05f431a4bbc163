"""The command ``srm-mbs``."""
