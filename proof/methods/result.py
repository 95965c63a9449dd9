"""What a method hands over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from series import Series


@dataclass
class Fitted:
    """Effects named, and the residual predicted for any recording of the same thing, in the unit of the signal."""

    named: list[str]
    predict: Callable[[Series], np.ndarray]
    parameters: dict | None = None
    note: str = ""
    # Effects that one of the method's terms stands for alike.
    classes: list[list[str]] = field(default_factory=list)


class DoesNotApply(Exception):
    """The method has nothing to say about such a recording."""
