"""One scalar unknown a case: scenes, how the unknown enters them, its gradient, and the matrix of all cases."""
