"""How one step is made: the contract (``base``), the methods, and Runge-Kutta data."""
