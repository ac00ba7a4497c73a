"""What is said where a package of an extra is missing."""

import contextlib
from collections.abc import Generator


@contextlib.contextmanager
def needs_extra(extra: str = "envs") -> Generator[None, None, None]:
    """Names the extra if an import in its block fails.

    Args:
      extra: its name in `jaxpets[...]`.

    Raises:
      ImportError: with the command that installs what is missing.
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"this environment needs the extra jaxpets[{extra}] ({error}); install it "
            f"with: pip install 'jaxpets[{extra}]'"
        ) from error
