"""Learning algorithms over hybrid actions, one file each. They know nothing of aircraft, files or plots."""
