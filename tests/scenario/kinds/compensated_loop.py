"""A drive in a loop with a compensator."""

from pathlib import Path

from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document

LOOP = """
scenario = { name = "loop", stop = 40.0, step = 0.01 }
[models.drive]
n_a = 4
A = [[0, 0, 1, 0], [0, 0, 0, 1], [-5, 4, -1.8, 0.8], [4, -5, 0.8, -1.8]]
Bu = [[0], [0], [1], [0]]
Bd = [[0], [0], [0], [1]]
C = [[0, 1, 0, 0], [0, 0, 0, 1]]
[components]
delta = { kind = "expression", y = "sin(1.6*t + 0.3)" }
theta = { kind = "constant", value = 1.6 }
exact = { kind = "constant", value = 0.0 }
plant = { kind = "descriptor", model = "drive", x_a0 = [0.0, 0.0, 0.0, 0.0] }
[components.observer]
kind = "unknown-input-observer"
model = "drive"
poles = [-6.0, -8.0]
filter_rate = 50.0
[components.compensator]
kind = "compensator"
Q = [1.0, 10.0, 1.0, 1.0]
regulated = [0]
terms = [{ family = "sine" }]
interval = [[1.0, 2.0]]
[connections]
"plant.u" = "compensator.u"
"plant.delta" = "delta.y"
"observer.u" = "compensator.u"
"observer.y" = "plant.y"
"compensator.x_a" = "observer.x_a"
"compensator.delta" = "observer.delta"
"compensator.y" = "plant.y"
"compensator.theta" = "theta.y"
"compensator.standard_error" = "exact.y"
"""


def scenario(**changes):
    """Return the loop with some keys of the compensator changed, or text in place of other text."""
    text = LOOP
    for old, new in changes.pop("replaced", {}).items():
        assert old in text
        text = text.replace(old, new)
    loaded = parse(Document(text, "loop.toml", Path()))
    return loaded.edit(set={f"compensator.{key}": value for key, value in changes.items()})
