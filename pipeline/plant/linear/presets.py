"""The plants of the three tables in Throne's paper, by name."""

from collections.abc import Mapping

import numpy as np

from pipeline.plant.linear.chain import Chain

# In V, cm and s, from the tables in Throne's paper. throne-1dof is exactly Table 1. throne-2dof
# rounds to all eight independent final values of Table 2. throne-3dof is the real chain nearest to
# Table 3. The last two have no spring to the near wall, because the best fit to the tables needs
# none.
PRESETS: Mapping[str, Chain] = {
    "throne-1dof": Chain(
        m=np.array([1.98587e-4]), c=np.array([5.24270e-4]), k=np.array([0.0346021, 0.0])
    ),
    "throne-2dof": Chain(
        m=np.array([3.128204e-4, 1.737182e-4]),
        c=np.array([6.663748e-4, 4.408337e-4]),
        k=np.array([0.0, 0.1274783, 0.06085252]),
    ),
    "throne-3dof": Chain(
        m=np.array([3.2732e-4, 2.516715e-4, 1.960671e-4]),
        c=np.array([1.520765e-3, 4.32763e-4, 3.40361e-4]),
        k=np.array([0.0, 0.1234592, 0.06648407, 0.06275727]),
    ),
}
