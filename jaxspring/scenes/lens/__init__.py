"""A spring lens: a net of springs over an image that magnifies parts of it, and squeezes the rest."""
