"""The simulator: scenes, dynamics, metrics, observations, agents. No torch."""
