"""Statements of a certificate: what may be built, and what may not."""

import math

import pytest

from lagros_policies.contraction.statement import Statement


def test_a_statement_keeps_what_it_was_given():
    statement = Statement("alpha = 0.5 1/s on the box", "proved", True, 1.5)
    assert (statement.kind, statement.holds, statement.seconds) == ("proved", True, 1.5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((" ", "proved", True, 0.0), "text"),
        (("x", "certain", True, 0.0), "kind='certain'"),
        (("x", "proved", True, -1.0), r"seconds=-1\.0"),
        (("x", "proved", True, math.nan), "seconds=nan"),
    ],
)
def test_impossible_statements_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Statement(*arguments)
