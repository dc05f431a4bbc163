"""The C source of a structure: terms, algebra and derivatives."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from srm_mbs.integration.generated.algebra import LARGEST_UNROLLED, algebra_of
from srm_mbs.integration.generated.frames import shortest_terms
from srm_mbs.integration.generated.linearisation import linearisation_of
from srm_mbs.integration.generated.structure import Structure

FEWEST_DIVIDED = 500
"""Statements from which on the algebra may be a unit of its own: with fewer, another compiler takes
longer to start than it saves."""
ABI = 3
"""Version of the functions that the kernel calls: ``interface_version`` in generated.cpp."""


class Source(NamedTuple):
    """The C of a structure.

    Attributes
    ----------
    text
        All of it.
    units
        Translation units into which it is worth dividing: where UNIT is defined, as 1, 2, ..., it
        has what belongs to that one.
    operations
        Number of its statements.
    """

    text: str
    units: int
    operations: int


def source_of(structure: Structure) -> Source:
    """The C source of the terms of ``structure``.

    It defines ``srm_mbs_sizes``, the sizes of its arguments; ``srm_mbs_constants``, which computes
    k from the parameters p; ``srm_mbs_terms``, of an evaluation; ``srm_mbs_factor`` and others, its
    algebra; and, for stiff steps, ``srm_mbs_linearise`` with constants of its own (generated.hpp).

    Raises
    ------
    UnsupportedElementError
        If two points of an element coincide in every configuration.
    """
    frame, recorded, written = shortest_terms(structure)
    linear = linearisation_of(structure, frame)
    laws = sum(force.laws.length for force in structure.forces)
    sizes = (
        *(ABI, structure.nq, structure.nv, structure.rows, structure.rank),
        *(len(structure.codes), written.constant_count, laws, len(structure.bushing_joints)),
        *(structure.held, linear.constant_count),
    )
    terms = _TERMS.format(
        turns=_TURNS,
        sizes=", ".join(map(str, sizes)),
        constants=written.constants,
        terms=written.terms,
    )
    parts = [terms + linear.text]
    algebra = _algebra(structure, [output.target for output in recorded.outputs])
    if algebra:
        # Algebra with loops needs the passes that unrolled algebra does not.
        parts.append((_ALL_PASSES if structure.nv > LARGEST_UNROLLED else "") + algebra)
    text = _HEAD.format(passes=_PASSES, prototypes=PROTOTYPES)
    for number, part in enumerate(parts, start=1):
        text += f"\n#if !defined UNIT || UNIT == {number}\n{part.strip()}\n#endif\n"
    operations = written.operations + linear.operations
    return Source(text, len(parts) if operations >= FEWEST_DIVIDED else 1, operations)


def _algebra(structure: Structure, targets: Sequence[str]) -> str:
    """The algebra for the entries of M and G among the ``targets`` of the terms."""
    mass, jacobian = set(), set()
    for target in targets:
        name, *places = re.findall(r"\w+", target)
        if name == "M":
            mass.add(divmod(int(places[0]), structure.nv)[::-1])
        elif name == "G":
            jacobian.add((int(places[0]), int(places[1])))
    return algebra_of(structure.nv, structure.rows, structure.rank, mass, jacobian)


# Statements without a branch, each computed once, leave nothing to these passes of GCC, which take
# a third of its time, in large mechanisms half; the first two find nothing in loops either.  The
# pragma, because Clang refuses the flags, and earlier versions of GCC forget those of the command
# line at it.
_PASSES = """\
#if __GNUC__ >= 12 && !defined __clang__
#pragma GCC optimize ("no-tree-dominator-opts,no-thread-jumps")
#pragma GCC push_options
#pragma GCC optimize ("no-tree-pre,no-code-hoisting,no-tree-pta,no-tree-slsr,no-tree-sink")
#pragma GCC optimize ("no-dse,no-rerun-cse-after-loop,no-ivopts,no-tree-tail-merge")
#pragma GCC optimize ("no-tree-loop-distribute-patterns,no-isolate-erroneous-paths-dereference")
#pragma GCC optimize ("no-ipa-icf,no-ipa-cp,no-ipa-sra,no-ipa-ra,no-ipa-modref")
#pragma GCC optimize ("no-ipa-pure-const,no-ipa-reference,no-tree-ccp,no-tree-bit-ccp")
#pragma GCC optimize ("no-tree-dse,no-cprop-registers")
#endif"""
_ALL_PASSES = """
#if __GNUC__ >= 12 && !defined __clang__
#pragma GCC pop_options
#endif
"""

# Headers would take longer to read than the terms of a small mechanism.
PROTOTYPES = """\
double sqrt(double), fabs(double), copysign(double, double), fmax(double, double);
double fmin(double, double), sin(double), cos(double), tanh(double);
void *memcpy(void *, const void *, __SIZE_TYPE__), *memset(void *, int, __SIZE_TYPE__);"""
"""Functions of C's library that the source calls."""

LARGEST_ANGLE = 1e6
"""Angle (rad) up to which its multiple of pi/2 has the bits that its products leave: 20."""

# Sines and cosines of several angles at a time.  An angle is reduced by the nearest multiple of
# pi/2, whose first two parts have 33 bits, so that their products with it are exact; the
# polynomials on [-pi/4, pi/4] are those of fdlibm (Sun Microsystems 1993, k_sin.c and k_cos.c).
# Errors are below 4 units in the last place up to LARGEST_ANGLE; beyond it the functions of the C
# library serve, which take one angle at a time.
_TURNS = """
/* Sines and cosines of angles: lanes without a use have the angle 0. */
typedef double angles __attribute__((vector_size(32)));
typedef long long angle_bits __attribute__((vector_size(32)));
typedef long long near_bits __attribute__((vector_size(16)));

static __attribute__((noinline, cold)) void turn_far(const angles *x, angles *sines,
                                                     angles *cosines) {
  for (int i = 0; i < 4; ++i) {
    (*sines)[i] = sin((*x)[i]);
    (*cosines)[i] = cos((*x)[i]);
  }
}

static inline __attribute__((always_inline)) void turn_all(const angles *given, angles *sines,
                                                       angles *cosines) {
  const angles x = *given;
  const angles count = x * 0x1.45f306dc9c883p-1 + 0x1.8p52, n = count - 0x1.8p52;
  const angles r = ((x - n * 0x1.921fb544p0) - n * 0x1.0b4611a6p-34) - n * 0x1.3198a2e037073p-69;
  const angles z = r * r, zz = z * z;
  const angles s = r + r * z * (-1.66666666666666324348e-01 +
      z * ((8.33333333332248946124e-03 - z * 1.98412698298579493134e-04) +
           zz * ((2.75573137070700676789e-06 - z * 2.50507602534068634195e-08) +
                 zz * 1.58969099521155010221e-10)));
  const angles half = 0.5 * z, w = 1.0 - half;
  const angles c = w + (((1.0 - w) - half) +
      zz * ((4.16666666666666019037e-02 - z * 1.38888888888741095749e-03) +
            zz * ((2.48015872894767294178e-05 - z * 2.75573143513906633035e-07) +
                  zz * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11))));
  const angle_bits quarter = (angle_bits)count, odd = -(quarter & 1);
  const angle_bits a = (angle_bits)s, b = (angle_bits)c;
  *sines = (angles)(((a & ~odd) | (b & odd)) ^ ((quarter & 2) << 62));
  *cosines = (angles)(((b & ~odd) | (a & odd)) ^ (((quarter + 1) & 2) << 62));
  const angle_bits near = (angle_bits)(x < @LARGEST@) & (angle_bits)(x > -@LARGEST@);
  near_bits low, high;
  memcpy(&low, &near, sizeof low);
  memcpy(&high, (const char *)&near + sizeof low, sizeof high);
  low &= high;
  if (!(low[0] & low[1])) turn_far(given, sines, cosines);
}
""".replace("@LARGEST@", repr(LARGEST_ANGLE))

_HEAD = """\
/* Terms of a mechanism and their algebra, generated by srm-mbs. */
{passes}
{prototypes}
"""

_TERMS = """\
/* q, v: coordinates and rates; p: parameters; k: what depends on them alone; s: values of laws
 * over time; held: whether y acts in place of the laws of elements, and nothing in place of those
 * of coordinates.
 * M: upper triangle, column by column; nle; tau, lawful: forces of elements without and with laws;
 * values, own: laws of elements and of coordinates; g, bias; G[row][column]; B, J: kinematics of
 * the bodies of bushings. */

/* Two equal operations at once; their constants are neighbours. */
typedef double pair __attribute__((vector_size(16)));
typedef double pair_at __attribute__((vector_size(16), aligned(8), may_alias));
{turns}
const int srm_mbs_sizes[] = {{{sizes}}};

void srm_mbs_constants(const double *restrict p, double *restrict k) {{
{constants}
}}

int srm_mbs_terms(const double *restrict q, const double *restrict v, const double *restrict k,
                  const double *restrict s, double held, const double *restrict y,
                  double *restrict M, double *restrict nle, double *tau, double *lawful,
                  double *restrict values, double *restrict own, double *restrict g,
                  double *restrict bias, double *const *G, double *const *B, double *J) {{
{terms}
  return 0;
}}
"""
