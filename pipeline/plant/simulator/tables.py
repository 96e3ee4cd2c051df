"""The input of the simulator: three tables of numbers for carts, springs and drive.

An effect fills columns of one row. With neutral values in all columns, the model is the linear
chain.
"""

from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np

from pipeline.arrays import Array
from pipeline.plant.chain import Chain
from pipeline.plant.simulator.columns import DRY, NEUTRAL, Cart, Drive, Spring

__all__ = ["DRY", "TABLES", "Cart", "Drive", "Spring", "Tables", "linear_tables"]

TABLES: dict[str, type[IntEnum]] = {"cart": Cart, "spring": Spring, "input": Drive}


class Tables(NamedTuple):
    """The columns of the effects, in tables for carts (n, .), springs (n + 1, .) and drive (.,)."""

    cart: Array
    spring: Array
    drive: Array


@cache
def _neutral(of: type[IntEnum]) -> Array:
    row = np.array([NEUTRAL.get(column.name, 0.0) for column in of])
    row.flags.writeable = False
    return row


def linear_tables(chain: Chain) -> Tables:
    """Return the tables of a chain without effects."""
    cart = np.tile(_neutral(Cart), (chain.n, 1))
    spring = np.tile(_neutral(Spring), (chain.n + 1, 1))
    cart[:, Cart.MASS], cart[:, Cart.DAMPING] = chain.m, chain.c
    spring[:, Spring.STIFFNESS] = chain.k
    return Tables(cart, spring, _neutral(Drive).copy())
