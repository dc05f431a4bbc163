"""Equations of motion behind the :class:`~srm_mbs.dynamics.system.System` protocol."""
