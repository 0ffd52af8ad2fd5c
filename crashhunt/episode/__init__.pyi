from ._episode import run_episode as run_episode, words_of as words_of
from ._parts import Braking as Braking, Parts as Parts, require_origin as require_origin, seal as seal
from ._settings import (
    WorkerSettings as WorkerSettings,
    answer_file as answer_file,
    scratch_of as scratch_of,
)
