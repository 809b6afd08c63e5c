"""How an actor and critics learn: the skeleton of all algorithms, their rules, gradient ascent, averages."""
