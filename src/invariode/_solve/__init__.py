"""What users call: `Problem`, `solve_ivp`, `odeint`, `ode45` and the others, prepared solvers, steppers, `load`."""
