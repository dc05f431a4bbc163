"""The thesis' own methods, apart from the default path: sweeps, their regularisation and SRM."""
