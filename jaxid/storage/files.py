"""Atomic writing of files."""

import contextlib
import os
import secrets
from pathlib import Path

from ..errors import SaveError, sentence


def write_whole(path: str | os.PathLike[str], content: bytes) -> Path:
    """Writes a file under a temporary name and renames it; an interruption keeps the old file.

    **Arguments:**

    - `path`: its folder must exist; an existing file is replaced.
    - `content`: bytes of the whole file.

    **Raises:** `SaveError` if it cannot be written.
    """
    path = Path(path)
    # In the same folder: renaming is atomic only within one file system.
    draft = path.parent / f".{secrets.token_hex(8)}.part"
    try:
        with open(draft, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path)
    except (OSError, ValueError) as error:
        raise SaveError(
            sentence(
                str(path),
                f"cannot be written ({error})",
                "choose an existing folder with free space and write permission",
            )
        ) from error
    finally:
        with contextlib.suppress(OSError, ValueError):
            draft.unlink(missing_ok=True)
    return path
