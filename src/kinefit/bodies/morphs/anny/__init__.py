"""The Anny body: a parametric person of any sex, age, height, build and proportions."""

from kinefit.bodies.morphs.anny.model import NAMES, AnnyFamily, AnnyModel, fetched_anny, load_anny

__all__ = ["NAMES", "AnnyFamily", "AnnyModel", "fetched_anny", "load_anny"]
