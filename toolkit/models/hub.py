"""Explains errors of the Hugging Face hub."""


def failure_reason(error: Exception, page: str = "the model's page") -> str:
    """Return why a request to the hub failed, as a phrase; `page` is where users accept the license."""
    from huggingface_hub import constants, errors

    status = status_of(error)
    sign_in = f"accept the license on {page} and set HF_TOKEN (HTTP {status})"
    if isinstance(error, errors.OfflineModeIsEnabled):
        return "HF_HUB_OFFLINE is set"
    if isinstance(error, errors.EntryNotFoundError) and status is not None:
        return f"{constants.ENDPOINT} has the repository, but no such file in it (HTTP {status})"
    if isinstance(error, errors.GatedRepoError):
        return f"access is restricted: {sign_in}"
    if isinstance(error, errors.RepositoryNotFoundError):
        return f"{constants.ENDPOINT} has no such repository, or restricts access to it: then {sign_in}"
    if status in (401, 403):
        return f"access is refused: {sign_in}"
    if status is not None:
        return f"{constants.ENDPOINT} answered HTTP {status}"
    text = str(error).strip().split("\n")[0].rstrip(".")
    return f"from {constants.ENDPOINT}, {type(error).__name__}" + (f": {text}" if text else "")


def status_of(error: Exception) -> int | None:
    """Return the HTTP status of an error of huggingface_hub; None if it has none."""
    return getattr(getattr(error, "response", None), "status_code", None)
