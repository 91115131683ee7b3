"""PURE, compiled: kinematics, elasticity, filter, law, allocation, voltage; ``tick`` composes them."""
