"""The replay service and the run's channels over Zenoh. Knows nothing of driving."""
