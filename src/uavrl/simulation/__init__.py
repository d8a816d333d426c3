"""The simulator: state, dynamics, observations and its Gymnasium environments."""
