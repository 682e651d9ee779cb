"""The paper's Figs. 4 to 12 and its tables made anew: simulate, learn, measure, draw, and say what differs."""

from tapetum.report.paper.workshop import RECIPES, Recipe, Workshop
from tapetum.report.paper.write import FIGURES, LEARNED, SIZES, Reproduction, reproduce

__all__ = ["FIGURES", "LEARNED", "RECIPES", "SIZES", "Recipe", "Reproduction", "Workshop", "reproduce"]
