from .sizes import SIZES, SMOKE_TEST, is_smoke_test
from .workshop import RECIPES, Recipe, Workshop
from .write import FIGURES, GROUPS, LEARNED, Reproduction, reproduce

__all__ = [
    "FIGURES",
    "GROUPS",
    "LEARNED",
    "RECIPES",
    "SIZES",
    "SMOKE_TEST",
    "Recipe",
    "Reproduction",
    "Workshop",
    "is_smoke_test",
    "reproduce",
]
