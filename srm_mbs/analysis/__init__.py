"""Around the simulation: energy balance, equilibria, linearisation, inverse dynamics, mobility."""
