"""The kinds of number that an equation of motion is evaluated on, and what they have in common.

A system states dx/dt once, as a function of numbers. What is passed in decides what comes out:

| kind       | what the equation then gives                                            |
|------------|-------------------------------------------------------------------------|
| float      | the rates at one state                                                  |
| array      | the rates at a batch of states                                          |
| `Dual`     | these and their exact derivatives (values may be any of the other kinds) |
| `Interval` | an enclosure of the rates over a whole box of states                    |
| `Series`   | enclosures of higher derivatives along one variable                     |
| `TaylorModel` | polynomials that enclose the rates over a ball of several variables  |
| `Recorded` | the list of its operations, to be run in buffers, compiled or exported  |

Every kind knows `+ - * /` with its own kind and with floats, the sign, integer powers and `abs`,
and the functions of `lagros_envs.numbers.functions`: `sin`, `cos`, `tan`, `exp`, `sqrt`. Nothing
else may be used in a `derivative`: no comparison and no branch on the state, no `min`, no `math` or
`numpy` of its own. (The rules of a task, such as who has fallen, are for floats, arrays,
`Interval` and `Recorded`, and may also compare, join comparisons by `&` and `|`, and choose by
`where`, `minimum` and `maximum`.)
"""

from lagros_envs.numbers import functions
from lagros_envs.numbers.dual import Dual
from lagros_envs.numbers.interval import Interval, exact
from lagros_envs.numbers.recorded import Recorded
from lagros_envs.numbers.series import Series, variable
from lagros_envs.numbers.taylor import TaylorModel, monomials

__all__ = [
    "Dual",
    "Interval",
    "Recorded",
    "Series",
    "TaylorModel",
    "exact",
    "functions",
    "monomials",
    "variable",
]
