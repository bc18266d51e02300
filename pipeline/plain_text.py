"""Text from outside that goes into files which others read."""


def plain_text(text: str) -> str:
    """Text of one line that every format can hold: each character that cannot be printed becomes a question mark."""
    return "".join(character if character.isprintable() else "?" for character in text)
