"""The two ways in which terrasim says no."""


class InputError(ValueError):
    """The caller's input breaks a rule: one line with the value, the rule and the remedy.

    The command line ends with exit status 2.
    """


class RunError(RuntimeError):
    """The input was fine but the work failed: one line that says why.

    The command line ends with exit status 1.
    """
