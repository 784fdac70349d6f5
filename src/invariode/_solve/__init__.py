"""The calls for users: `Problem`, `solve_ivp`, `odeint`, `ode45` and the others, prepared solvers, steppers, `load`."""
