"""Sines and cosines of several angles at a time, as C.

An angle is reduced by the nearest multiple of pi/2, whose first two parts have 33 bits, so that
their products with it are exact; the polynomials on [-pi/4, pi/4] are those of fdlibm (Sun
Microsystems 1993, k_sin.c and k_cos.c).  Errors are below 4 units in the last place up to
LARGEST_ANGLE; beyond it the functions of the C library serve, which take one angle at a time.
"""

from __future__ import annotations

LARGEST_ANGLE = 1e6
"""Angle (rad) up to which its multiple of pi/2 has the bits that its products leave: 20."""

TURNS = """
/* Sines and cosines of angles: lanes without a use have the angle 0. */
typedef double angles __attribute__((vector_size(32)));
typedef long long angle_bits __attribute__((vector_size(32)));

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
  if (!(near[0] & near[1] & near[2] & near[3])) turn_far(given, sines, cosines);
}
""".replace("@LARGEST@", repr(LARGEST_ANGLE))
