"""Values as a scenario file has them."""


def toml_of(value):
    """Write a value as TOML, as far as TOML has it."""
    match value:
        case bool():
            return str(value).lower()
        case dict():
            pairs = [f"{toml_of(str(key))} = {toml_of(item)}" for key, item in value.items()]
            return "{ " + ", ".join(pairs) + " }"
        case list() | tuple():
            return "[" + ", ".join(map(toml_of, value)) + "]"
        case float():
            return repr(value)
        case int():
            return str(value) if abs(value) < 10**4000 else "9" * 4400
        case _:
            letters = [
                f"\\U{ord(c):08X}" if not 0xD800 <= ord(c) < 0xE000 else "?" for c in str(value)
            ]
            return '"' + "".join(letters) + '"'
