"""What may go wrong in an alignment, as exceptions that say what to do."""


class AlignmentError(Exception):
    """Base of this package's errors."""


class NotEnoughDataError(AlignmentError):
    """Too few readings, or angles too few or too much alike, for what is asked."""


class UnobservableError(AlignmentError):
    """The geometry carries no information about what is asked, however long one measures."""
