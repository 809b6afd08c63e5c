"""RiverGrid (paper, section 5): the grid world, its maps, generated instances and their limits."""
