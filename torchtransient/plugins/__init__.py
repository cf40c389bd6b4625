"""Mitsuba plugins in Python. They know Mitsuba and Dr.Jit and never torch.

Importing this package lets Mitsuba call us whenever its variant changes; see `_registry`. Mitsuba's ``load_dict`` takes
the dictionaries of this library from then on; see `dictionaries`.
"""

from torchtransient.plugins._registry import attach as _attach
from torchtransient.plugins._registry import kind_of as kind_of
from torchtransient.plugins._registry import modules_of_others as modules_of_others
from torchtransient.plugins._registry import plugin_errors as plugin_errors
from torchtransient.plugins._registry import register as register
from torchtransient.plugins._registry import register_module as register_module
from torchtransient.plugins._registry import sync as sync
from torchtransient.plugins._registry import versions_of_others as versions_of_others
from torchtransient.plugins.dictionaries import take_arrays as _take_arrays
from torchtransient.plugins.parameter_effect import ParameterEffect as ParameterEffect
from torchtransient.plugins.parameter_effect import declare_effects as declare_effects

_attach()
_take_arrays()
