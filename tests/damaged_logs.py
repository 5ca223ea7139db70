"""What every importer must do with a log that is damaged somewhere."""

import numpy as np

from cfplan.errors import InputError
from cfplan.recording.importers.formats import read_log


def log_or_error(file):
    try:
        return read_log(file)
    except InputError as error:
        return error


def check_damaged(file):
    """Check that a file is an error in one line, or a log whose poses are in order."""
    log = log_or_error(file)
    if isinstance(log, InputError):
        assert "\n" not in str(log)
        return
    for subject in log.subjects:
        assert subject.position.shape == (len(subject.time), 3)
        assert np.all(np.diff(subject.time) > 0)
