"""Errors whose message is meant for the user: what was found, where, what was expected, what to do."""


class ToolkitError(Exception):
    """Base of all errors that the command line prints without a traceback."""


class CaptureError(ToolkitError):
    """A capture folder or one of its files is not as the format wants it."""


class ManifestError(ToolkitError):
    """A manifest or a parameter is not valid."""


class ArtifactError(ToolkitError):
    """A file that an earlier stage should have written is missing, torn or made from something else."""


class ImageError(ToolkitError):
    """An image file is missing or cannot be decoded."""


class WeightsError(ToolkitError):
    """Weights are missing, cannot be fetched, are damaged, or are those of another network."""


class DownloadError(ToolkitError):
    """A capture, or a file of it, cannot be listed, fetched, unpacked or put in its place."""


def first_line(error: BaseException) -> str:
    """Return the kind and the first line of an error."""
    return f"{type(error).__name__}: {str(error).strip()}".split("\n")[0].rstrip(".")[:300]
