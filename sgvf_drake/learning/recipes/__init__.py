"""The recipes; a new one is a module here and an entry of `RECIPES`."""

from sgvf_drake.learning.recipes.exact import ExactRecipe
from sgvf_drake.learning.recipes.paper import PaperRecipe
from sgvf_drake.learning.recipes.recipe import Fitted, Recipe
from sgvf_drake.learning.recipes.robust import RobustRecipe

RECIPES: dict[str, Recipe] = {
    recipe.name: recipe for recipe in (PaperRecipe(), RobustRecipe(), ExactRecipe())
}
"""The recipes by their names."""

__all__ = ["RECIPES", "Fitted", "Recipe"]
