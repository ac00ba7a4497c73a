"""What is said where a package of the extra `envs` is missing."""

import contextlib
from collections.abc import Generator


@contextlib.contextmanager
def needs_extra() -> Generator[None, None, None]:
    """Names the extra if an import in its block fails.

    Raises:
      ImportError: with the command that installs what is missing.
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"this environment needs the extra jaxpets[envs] ({error}); install it "
            "with: pip install 'jaxpets[envs]'"
        ) from error
