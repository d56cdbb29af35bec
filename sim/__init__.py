"""The simulator: scenes, dynamics, metrics, observations, agents. JAX and numpy only."""
