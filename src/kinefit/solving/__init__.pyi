"""Public names: Rows, equations and solvers."""

from kinefit.solving.rows import Rows as Rows
from kinefit.solving.equations import covariance as covariance, joint_std as joint_std
from kinefit.solving.least_squares import gauss_newton as gauss_newton, levenberg_marquardt as levenberg_marquardt
from kinefit.solving.functional_joints import functional_axis as functional_axis, functional_centre as functional_centre
