"""Reproduce the paper's Figs. 4 to 12 and its tables: simulate, learn, measure, draw, and state the differences."""

from tapetum.experiments.sizes import SIZES, SMOKE_TEST, is_smoke_test
from tapetum.experiments.workshop import RECIPES, Recipe, Workshop
from tapetum.experiments.write import FIGURES, GROUPS, LEARNED, Reproduction, reproduce

__all__ = ["FIGURES", "GROUPS", "LEARNED", "RECIPES", "SIZES", "SMOKE_TEST", "Recipe", "Reproduction", "Workshop"]
__all__ += ["is_smoke_test", "reproduce"]
