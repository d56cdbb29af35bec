"""The learner: the network in torch, double DQN, checkpoints."""
