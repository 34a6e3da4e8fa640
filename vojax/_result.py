"""Result codes: failure is a value with a sentence, never an exception inside jit."""

import equinox as eqx


class Result(eqx.Enumeration):
    """How an estimation ended. `Result[code]` is the sentence of a code; compare codes with `==`."""

    success = "The estimate converged on enough observations."
    not_converged = "The refinement used all its steps before it converged; the estimate is the best point it saw."
    degenerate = "The observations do not determine the model: a direction has no information."
    no_consensus = "No hypothesis had more supporters than chance would give it."
    too_few = "Fewer valid observations than a minimal sample needs."
