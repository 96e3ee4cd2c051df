"""The errors, named for who must act.

Every message is one line a person can act on: where, what was needed, what was found.
"""


class PipelineError(Exception):
    """Anything cartlab cannot go on from; the command line prints its text and exits 2."""


class DataError(PipelineError):
    """The measured data do not support what was asked of them: look at the recording."""


class SubmissionError(PipelineError):
    """The submission's files are wrong or missing: look at `submission.toml` and `data/`."""


class ConfigError(PipelineError):
    """A rubric, preset, option or output folder is wrong: the person at the keyboard acts."""


class HardwareError(PipelineError):
    """The bench does not answer as it should: look at the cable, the port, the motor."""
