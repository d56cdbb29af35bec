"""Actors: the policy in JAX, the acting loop, evaluation. No torch."""
