"""Off-policy learning: transitions, replay buffer, target networks, deep Q-learning and DDPG."""
