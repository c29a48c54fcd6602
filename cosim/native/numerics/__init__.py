"""Linear algebra, elementary functions, expressions in t, Runge-Kutta methods."""
