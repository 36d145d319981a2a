"""From files of a character or a body in many poses to a trained model, in one resumable run."""

from lcollision_core.learning.card import LearnedCard, card_of
from lcollision_core.learning.effort import EFFORTS, Effort
from lcollision_core.learning.estimate import estimated_seconds
from lcollision_core.learning.first_samples import MostlyCollidingError
from lcollision_core.learning.learning_run import learn_model
from lcollision_core.learning.sources import ENOUGH_POSES, gather_poses
from lcollision_core.learning.work_folder import WorkFolder, list_work
from lcollision_core.learning_state import STAGES, LearningStatus, RunState, Stage
from lcollision_core.options import LearningRequest, Quality
