"""A network of one's own: two residual blocks, for the policy and every critic of any built-in agent."""

from torch import nn

WIDTH = 64


class Block(nn.Module):
    """x + f(x), with the mean and the size of x taken out before f."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.LayerNorm(WIDTH), nn.Linear(WIDTH, WIDTH), nn.SiLU(), nn.Linear(WIDTH, WIDTH)
        )

    def forward(self, rows):
        return rows + self.body(rows)


def residual_network(inputs: int, outputs: int) -> nn.Module:
    """A module from observations, [U, inputs], to [U, outputs]: action logits, or a value."""
    return nn.Sequential(nn.Linear(inputs, WIDTH), Block(), Block(), nn.Linear(WIDTH, outputs))
