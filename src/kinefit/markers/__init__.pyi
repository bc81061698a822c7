"""Public names: Unlabelled markers."""

from kinefit.markers.audit.audit import audit_take as audit_take
from kinefit.markers.frame.identify import identify as identify
from kinefit.markers.model.from_frame import model_from_frame as model_from_frame
from kinefit.markers.model.learn import learn_model as learn_model
from kinefit.markers.model.learn import training_gate as training_gate
from kinefit.markers.take.takes import identify_people as identify_people
from kinefit.markers.take.takes import identify_take as identify_take
