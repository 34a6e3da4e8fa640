"""How the API pages read vojax's docstrings: what differs between them and griffe's idea of Google's style."""

import re

import griffe

# "Degenerate input: …" is a paragraph of its own that opens with its title in bold.
_TITLE = re.compile(r"^(Degenerate input|Differentiability|References): (?=\S)", re.MULTILINE)
# "[3, 4] [A, b]" are two arrays, not a link.
_ARRAYS = re.compile(r"\](?=\s?[\[(])")
# Bases of equinox modules, the cameras' own among them.
_MODULE = re.compile(r"eqx\.Module|(Plane|Wide|Central)Camera")


class VojaxDocstrings(griffe.Extension):
    """Rewrite each docstring before it is parsed."""

    def on_instance(self, *, obj, **kwargs):
        """Called by griffe for every module, class, function and attribute."""
        if obj.docstring is None:
            return
        text, example, code = obj.docstring.value.partition("Example:\n")
        if obj.is_class and not obj.decorators:
            text = text.replace("Args:\n", "Attributes:\n")  # equinox modules: their fields are their arguments
        text = _TITLE.sub(r"\n**\1:** ", text)
        pieces = text.split("`")
        pieces[::2] = [_ARRAYS.sub(r"\\]", piece) for piece in pieces[::2]]
        obj.docstring.value = "`".join(pieces) + ("Examples:\n" if example else "") + code

    def on_class_members(self, *, cls, **kwargs):
        """Give an equinox module the initialiser that it has from its fields, and so a signature."""
        fields = [x for x in cls.members.values() if x.is_attribute and "instance-attribute" in x.labels]
        if "__init__" in cls.members or not fields or not any(_MODULE.match(str(base)) for base in cls.bases):
            return
        kind = griffe.ParameterKind.positional_or_keyword
        parameters = [griffe.Parameter(x.name, annotation=x.annotation, kind=kind, default=_default(x)) for x in fields]
        initialiser = griffe.Function("__init__", parameters=griffe.Parameters(griffe.Parameter("self"), *parameters))
        cls.set_member("__init__", initialiser)


def _default(field):
    """The default of a field, in `x = 0.0` and in `x = eqx.field(…, default=0.0)`."""
    written = str(field.value) if field.value is not None else ""
    if not written.startswith("eqx.field("):
        return field.value
    found = re.search(r"default=([^,()]+|\([^()]*\))", written)
    return found.group(1) if found else None
