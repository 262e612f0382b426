"""Explains errors of the Hugging Face hub."""


def failure_reason(error: Exception, page: str = "the model's page", url: str = "") -> str:
    """Return why a request failed, as a phrase; users accept the license on `page`, and `url` is empty for the hub."""
    from huggingface_hub import constants, errors

    status, server = status_of(error), url or constants.ENDPOINT
    sign_in = f"accept the license on {page} and set HF_TOKEN (HTTP {status})"
    if isinstance(error, errors.OfflineModeIsEnabled):
        return "HF_HUB_OFFLINE is set"
    if isinstance(error, errors.EntryNotFoundError) and status is not None:
        return f"{server} has the repository, but no such file in it (HTTP {status})"
    if isinstance(error, errors.GatedRepoError):
        return f"access is restricted: {sign_in}"
    if isinstance(error, errors.RepositoryNotFoundError):
        return f"{server} has no such repository, or restricts access to it: then {sign_in}"
    if status in (401, 403):
        return f"access is refused: {sign_in}"
    if status is not None:
        return f"{server} answered HTTP {status}"
    text = str(error).strip().split("\n")[0].rstrip(".")
    return f"from {server}, {type(error).__name__}" + (f": {text}" if text else "")


def status_of(error: Exception) -> int | None:
    """Return the HTTP status of an error of huggingface_hub; None if it has none."""
    return getattr(getattr(error, "response", None), "status_code", None)
