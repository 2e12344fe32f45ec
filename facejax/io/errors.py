"""Error messages about untrusted files: one printable line, whatever the file contains."""

MAX_MESSAGE_CHARS = 1000  # approximately: longer messages are shortened in the middle


class FileError(ValueError):
    """A file cannot be used. The message is one printable line, even where it quotes the file."""

    def __init__(self, message: str):
        super().__init__(one_line(message))


def one_line(text: object) -> str:
    """Return a text as one line without control characters, shortened to its beginning and end if it is long."""
    text = str(text)
    if len(text) > MAX_MESSAGE_CHARS:
        text = f"{text[: MAX_MESSAGE_CHARS // 2]} ... {text[-MAX_MESSAGE_CHARS // 2 :]}"
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
