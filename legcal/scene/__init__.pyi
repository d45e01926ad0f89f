from .motions import FACTORS as FACTORS
from .motions import directions as directions
from .motions import joints_at as joints_at
from .motions import step_shown as step_shown
from .shapes import around as around
from .shapes import ellipsoids as ellipsoids
from .shapes import enlargement as enlargement
from .shapes import pyramid as pyramid
