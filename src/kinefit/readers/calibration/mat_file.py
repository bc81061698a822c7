"""Program that prints the variables of a MATLAB file as JSON: scipy crashes on some damaged files, and ends only it."""

import json
import sys

import numpy as np
from scipy.io import loadmat


def _plain(value: object) -> object:
    """Convert a value of scipy's reader to dicts, lists, texts and numbers; TypeError for an object of MATLAB."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray) and value.dtype.names is None and value.dtype != object:
        return value.tolist()
    if isinstance(value, list | np.ndarray) and type(value).__name__ != "MatlabOpaque":
        return [_plain(inner) for inner in value]
    if not isinstance(value, str | int | float | np.generic):
        raise TypeError(type(value).__name__)
    return value.item() if isinstance(value, np.generic) else value


if __name__ == "__main__":
    answer: dict[str, object]
    try:
        found = loadmat(sys.argv[1], simplify_cells=True)
        answer = {"variables": {key: _plain(value) for key, value in found.items() if not key.startswith("__")}}
    except NotImplementedError:
        answer = {"version": "7.3"}
    except TypeError as error:
        answer = {"object": str(error)}
    except Exception as error:  # a damaged file can raise anything
        answer = {"damage": f"{type(error).__name__}: {error}"}
    print(json.dumps(answer, default=str))
