"""Pure functions of arrays, one per equation, for NumPy and torch alike (Array API); units in the names."""
