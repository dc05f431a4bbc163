// Thresholds and gains of the integration, in one struct that Python fills (marshalling.py): each
// has its source, and its reasons, in the module of the reference that is named here.
#pragma once

#include "struct_fields.hpp"

namespace srm {

#define SRM_CONSTANTS(field)                                                                       \
    /* Branch stages and zone: methods/near_singular.py. */                                        \
    field(double, monitored_below)         /* sigma below which steps look for singularities */    \
    field(double, near_steps)              /* distance (steps) from which stages are projected */  \
    field(double, far_steps)               /* distance (steps) beyond which nothing is prepared */ \
    field(double, ambiguous_offset)        /* largest distance from the branch, over sigma */      \
    field(double, held_tolerance)          /* part of the tolerance that held normals may cost */  \
    field(double, position_rounding)       /* rounding of positions, at most (units) */            \
    field(double, usual_rounding)          /* what it usually is, over position_rounding */        \
    field(double, crossing_sigma)          /* sigma at the ends of a crossing step / its change */ \
    field(double, lead_steps)              /* distance (steps) from which steps stay long */       \
    field(double, largest_rounding_floor)  /* relative error of rounding that is accepted */       \
    field(double, zone_largest)            /* largest threshold of the zone (sigma) */             \
    field(double, count_uncertainty_above) /* change of sigma per step; see step_error */          \
    field(double, direct_hit)              /* sigma below which any prediction is better */        \
    field(int, max_projections)            /* Newton steps onto the branch, per stage */           \
    field(int, min_history)                /* nodes from which the prediction is better */         \
    /* Branch nodes: methods/branch_nodes.py. */                                                   \
    field(double, known_direction)         /* sigma from which the state has a direction */        \
    field(double, direction_probe)         /* motion that measures it, over sigma */               \
    field(double, node_spacing)            /* distance of nodes (units) */                         \
    field(int, node_doublings)             /* of it, where sigma grows slowly */                   \
    field(double, node_sigma)              /* of the first nodes, for which they are far enough */ \
    field(int, node_iterations)            /* onto the closures */                                 \
    field(double, node_closing)            /* largest first one, over the spacing */               \
    field(double, node_accuracy)           /* last one (units) */                                  \
    field(double, node_rounding)           /* the same, where it does not shrink */               \
    field(double, node_misfit)             /* largest relative error of the multiplier */          \
    /* Touching branches: methods/touching_branches.py. */                                         \
    field(double, touching)                /* distance of the first nodes (units), at least */     \
    field(double, touching_farthest)       /* and at most */                                       \
    field(double, touching_spacing)        /* distance of the others from each other */            \
    field(int, touching_nodes)             /* on each side */                                      \
    field(int, touching_samples)           /* of sigma, on each side */                            \
    field(double, touching_least)          /* sigma of nodes, at least */                          \
    field(double, touching_sigma)          /* that of the first ones */                            \
    field(double, touching_accuracy)       /* last Newton step of a node (units) */                \
    field(double, touching_settled)        /* last motion to where the drives are (units) */       \
    field(double, touching_misfit)         /* of the polynomial (units) */                         \
    field(double, touching_residual)       /* closure error of its points (row units) */           \
    field(double, branch_below)            /* sigma below which lingering stages use them */       \
    /* Evaluation of all closure rows: methods/split_step.py. */                                   \
    field(int, residual_interval)          /* accepted steps between two of them */                \
    /* Stiffness: methods/stiffness.py; differences: methods/linear_split_step.py. */               \
    field(int, stiff_steps)                /* that show that a problem is, or is not, stiff */     \
    field(int, other_steps)                /* in a row that end a count */                         \
    field(int, dear_steps)                 /* that show that implicit steps are dear */            \
    field(double, not_stiff)               /* h |lambda| up to which explicit steps would do */    \
    field(int, power_iterations)                                                                   \
    field(double, unresolved)              /* change of a rate over a step (friction speeds) */    \
    field(double, reversal_share)          /* error of a jump in a step, over step times jump */   \
    field(double, friction_layer)          /* rates of full friction (friction speeds) */          \
    field(double, layer_landing)           /* rate up to which a step ends beside it (layers) */   \
    field(double, layer_approached)        /* rate of steps whose stages miss one, over the first */ \
    field(double, layer_unresolved)        /* change of a rate that misses one (layers) */         \
    field(double, difference)              /* by a coordinate, over its size */                    \
    field(double, central_difference)      /* the same, central */                                 \
    field(double, friction_difference)     /* of a rate, over the speed of friction, at most */    \
    field(double, time_difference)         /* by time, over the step */                            \
    field(double, shortest_difference)     /* by time (roundings of t) */                          \
    /* Step-size control: control/step_size.py. */                                                 \
    field(double, safety)                                                                          \
    field(double, min_factor)                                                                      \
    field(double, max_factor)                                                                      \
    field(double, proportional)            /* exponent of the last error ratio */                  \
    field(double, integral)                /* exponent of the error ratio */                       \
    field(double, previous_error_floor)                                                            \
    field(double, error_floor)                                                                     \
    field(double, failed_evaluation)       /* error ratio of a step that could not be evaluated */ \
    field(double, rate_overflow)           /* rates from which products may overflow */            \
    field(double, first_step_probe)        /* relative change that the first step may make */      \
    field(double, longest_first_step)      /* over the probing step */                             \
    field(double, at_rest)                 /* change of rates at rest, over the probing step */    \
    field(double, rest_probe_late)         /* parts of the interval at which */                    \
    field(double, rest_probe_early)        /* the end of a rest shows */                           \
    field(double, rest_ends)               /* change of the rates there */                         \
    field(double, rest_factor)             /* of the times at which its end is looked for */       \
    field(double, clock_rounding)          /* of the end of a step, over its length, that counts */ \
    /* Placement: control/placement.py. */                                                         \
    field(double, max_sigma_change)        /* per step */                                          \
    field(double, scatter_from)            /* least abscissa of slopes of a sigma that jumps */        \
    field(double, too_close)               /* sigma of a stage, over slope times step */           \
    field(double, clearance)               /* from abscissae, over half the widest gap */          \
    field(double, zero_horizon)            /* steps within which zeros of sigma are predicted */   \
    field(int, max_placements)             /* tries per step */                                    \
    field(double, singular_end)            /* sigma below which an end counts as singular */       \
    field(double, arrival_sigma_change)    /* distance from which such an end is prepared for */   \
    field(double, turning_sigma)           /* extreme of sigma at which a motion turns back */     \
    field(double, turning_misfit)          /* of the parabola, over the change of sigma */         \
    field(double, slow_sigma_change)       /* per step, of a slow motion */                        \
    /* Branch guard: control/branch_guard.py. */                                                   \
    field(double, branch_change)           /* relative change of velocity that is suspect */       \
    field(int, max_guard_retries)          /* tries per step */                                    \
    /* Driver: driver.py, singular_endpoints.py, breakpoints.py. */                                \
    field(double, smallest_step)           /* over the length of the run */                        \
    field(double, standstill)              /* progress in standstill_steps / length of run */ \
    field(int, standstill_steps)                                                                   \
    field(double, large_correction)        /* units */                                             \
    field(double, open_residual)           /* of rows, before the correction */                    \
    field(double, lost_residual)           /* of rows, after the correction */                     \
    field(int, max_jump_steps)             /* tries to end a step on a jump of forces */           \
    field(double, search_below)            /* sigma below which singularities are searched for */  \
    field(double, search_factor)           /* fall of sigma from one search to the next */         \
    field(double, rounding_share)          /* of the tolerance, in the first stage of a piece */   \
    /* Critical configurations: singularities/critical.py, critical_passages.py. */                \
    field(int, critical_iterations)                                                                \
    field(double, critical_difference)     /* step of the differences of G^T u (units) */          \
    field(double, critical_decided)        /* size of the equations: a zero residual is known */   \
    field(double, critical_accepted)       /* that from which the search has failed */             \
    field(double, critical_converged)      /* and that at rounding */                              \
    field(double, critical_frozen)         /* step up to which the Hessian is kept (units) */      \
    field(double, critical_converging)     /* fall of the equations up to which it is too */       \
    field(double, critical_ridge)          /* added to the Hessian's diagonal */                   \
    field(double, critical_time_ridge)     /* the same for time */                                 \
    field(double, critical_reach)          /* of the search (units) */                             \
    field(double, critical_farthest)       /* distance (units) from which a motion waits */        \
    field(double, critical_passed)         /* distance that is a passage, over that of the start */ \
    field(double, falling_sigma)           /* over the largest one, before another layer */        \
    field(double, dead_point_width)        /* of a layer, at most */                               \
    field(double, dead_point_widths)       /* at which the curve is earlier than in the middle */  \
    field(double, rounded_residual)        /* that of a singular configuration (row units) */      \
    field(double, stepped_residual)        /* that up to which steps pass it */                    \
    field(double, examined_again)          /* fall of sigma after a search without a passage */    \
    field(double, dependent_row)           /* remainder of a row that depends on others */         \
    field(double, definite)                /* ratio of the curvatures of a saddle, at least */     \
    field(double, largest_deviation)       /* from the hyperbola, over the distance */             \
    field(double, straight)                /* deviation of a slope from that of a branch */        \
    field(double, layer)                   /* |xi| of the panel in the middle */                   \
    field(double, shortest_panel)          /* in xi */                                             \
    field(double, panel_error)             /* of interpolation (units), over rtol */               \
    field(double, relative_panel_error)    /* of interpolation, over the size of the panel */      \
    field(double, panel_shrinkage)         /* ratio of lengths that are tried */                   \
    field(double, panel_shortened)         /* one beyond a layer, over that where it slows down */ \
    field(double, least_energy)            /* on a panel beyond a layer, over that at its start */ \
    field(double, curvature)               /* distance of the curve's singularity (units) */       \
    field(int, passage_sweeps)                                                                     \
    field(int, bisections)                                                                         \
    field(double, passage_converged)       /* last Newton step of a place, over rtol */            \
    field(int, placing_steps)              /* onto the curve, before an evaluation there */        \
    field(double, converging)              /* ratio of such steps up to which they are made */     \
    field(double, passage_turned)          /* last relative change of rates, over rtol */          \
    field(double, spent_energy)            /* that forces may change in a start, of the kinetic */ \
    field(double, layers_left)             /* reach of such a start, over the layer, at least */   \
    field(double, place_rounding)          /* of a place (units^2), times its distance */          \
    field(double, extrapolated)            /* |beta| from which the deviation is known */          \
    field(double, panel_cut)               /* length of a panel that ends in a stop */             \
    field(double, panel_cut_from)          /* and that below which it is cut so */                 \
    field(double, smallest_rest)           /* of a passage, over its whole */                      \
    field(double, expected_steps)          /* steps within which a zero of sigma is examined */   \
    field(double, expected_sigma)          /* sigma below which it is, wherever it lies */

struct Constants {
    SRM_FIELDS(SRM_CONSTANTS)
};

}  // namespace srm
