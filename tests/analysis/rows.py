"""Rows of data frames by the values of their columns."""

import numpy as np
import pandas as pd

ONE_COST = ("",)  # suffixes of the column of one cost


def only(frame: pd.DataFrame, **values: object) -> pd.Series:
    """The one row that has these values."""
    chosen = frame.loc[np.logical_and.reduce([frame[name] == value for name, value in values.items()])]
    assert len(chosen) == 1
    return chosen.iloc[0]
