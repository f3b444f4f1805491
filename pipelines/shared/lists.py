"""Lists given on the command line."""


def split_list(values: list[str] | None) -> list[str]:
    """Flatten a flag that may be repeated and may hold commas."""
    return [item.strip() for value in values or [] for item in value.split(",") if item.strip()]
