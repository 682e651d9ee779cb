"""The paper's Figs. 4 to 12 and its tables reproduced: simulate, learn, measure, draw, and say what differs."""

from tapetum.experiments.sizes import SIZES, SMOKE_TEST, is_smoke_test
from tapetum.experiments.workshop import RECIPES, Recipe, Workshop
from tapetum.experiments.write import FIGURES, GROUPS, LEARNED, Reproduction, reproduce

__all__ = ["FIGURES", "GROUPS", "LEARNED", "RECIPES", "SIZES", "SMOKE_TEST", "Recipe", "Reproduction", "Workshop"]
__all__ += ["is_smoke_test", "reproduce"]
