from .motions import FACTORS as FACTORS
from .motions import PlacedModel as PlacedModel
from .motions import directions as directions
from .motions import placed_model as placed_model
from .shapes import around as around
from .shapes import ellipsoids as ellipsoids
from .shapes import enlargement as enlargement
from .shapes import pyramid as pyramid
