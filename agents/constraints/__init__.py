"""How an agent measures its constraints and moves its Lagrange multipliers."""
