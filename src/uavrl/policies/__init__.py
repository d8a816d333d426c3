"""What needs no learning: heuristics and the rollout planner."""
