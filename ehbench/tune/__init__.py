"""Linear models of a cylinder at operating points, and the gain of the pressure feedback chosen
from them."""
