"""Public names: Rows, equations and solvers."""

from kinefit.solving.equations import covariance as covariance
from kinefit.solving.equations import joint_std as joint_std
from kinefit.solving.functional_joints import functional_axis as functional_axis
from kinefit.solving.functional_joints import functional_centre as functional_centre
from kinefit.solving.least_squares import gauss_newton as gauss_newton
from kinefit.solving.least_squares import levenberg_marquardt as levenberg_marquardt
from kinefit.solving.rows import Rows as Rows
