"""Decks with parts and assemblies, as Abaqus/CAE writes them, in the flat form CalculiX reads."""

from collections.abc import Callable

from snrmjax.io.calculix.blocks import Block, Line

_ADDED = "_IN_PART"
_NAMES = ("NSET", "ELSET")


def flattened(blocks: list[Block]) -> list[Block]:
    """A deck of one part with one instance at its place, without part and assembly.

    Sets of the part get a name of their own: an assembly may use the same name for another set,
    which CalculiX would join. Returns the blocks as they are where there is no part. Raises
    `ValueError` for several parts or instances and for an instance that is moved.
    """
    heads = {key: [b for b in blocks if b.keyword == key] for key in ("PART", "INSTANCE")}
    if not heads["PART"] and not heads["INSTANCE"]:
        return blocks
    for key, found in heads.items():
        if len(found) != 1:
            place = found[1].head.place if len(found) > 1 else blocks[0].head.file
            raise ValueError(
                f"{place}: {len(found)} *{key} blocks; a deck with one part and one instance can "
                "be read. Write others without parts and assemblies (in Abaqus/CAE: `Do not use "
                "parts and assemblies in input files`)."
            )
    (instance,) = heads["INSTANCE"]
    if instance.data:
        raise ValueError(
            f"{instance.data[0].place}: the instance is moved or turned; write the deck without "
            "parts and assemblies."
        )
    named = instance.named("NAME")
    result: list[Block] = []
    in_part = False
    for block in blocks:
        if block.keyword in ("PART", "END PART"):
            in_part = block.keyword == "PART"
        elif block.keyword not in ("ASSEMBLY", "END ASSEMBLY", "INSTANCE", "END INSTANCE"):
            result.append(_in_part(block) if in_part else _outside(block, named))
    return result


def _in_part(block: Block) -> Block:
    renamed = {name: block.parameters[name] + _ADDED for name in _NAMES if block.named(name)}
    data = block.data
    if block.keyword in _NAMES and "GENERATE" not in block.parameters:
        data = tuple(_mapped(line, lambda name: name + _ADDED) for line in data)
    elif block.keyword == "BOUNDARY":
        data = tuple(_mapped(line, lambda name: name + _ADDED, first_only=True) for line in data)
    return block.with_parameters(**renamed)._replace(data=data)


def _outside(block: Block, instance: str) -> Block:
    """Names `instance.set` are sets of the part."""

    def plain(name: str) -> str:
        owner, dot, own = name.partition(".")
        if not dot or owner.upper() != instance:
            return name
        return own if own.isdigit() else own + _ADDED

    data = tuple(
        _mapped(line, plain, first_only=block.keyword not in _NAMES) for line in block.data
    )
    return block.with_parameters(INSTANCE=None)._replace(data=data)


def _mapped(line: Line, renamed: Callable[[str], str], *, first_only: bool = False) -> Line:
    """A line with its names, those of its first entry only where that is a set, renamed."""
    entries = line.entries
    last = 1 if first_only else len(entries)
    new = [renamed(e) if e and not _is_number(e) else e for e in entries[:last]] + entries[last:]
    return line if new == entries else line._replace(text=", ".join(new))


def _is_number(entry: str) -> bool:
    try:
        float(entry)
    except ValueError:
        return False
    return True
