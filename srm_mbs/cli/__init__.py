"""The command line ``srm-mbs``."""
