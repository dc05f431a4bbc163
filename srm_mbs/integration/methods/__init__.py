"""One-step methods: Runge-Kutta tableaus, the split PSRM, and the sweeps of the thesis."""
