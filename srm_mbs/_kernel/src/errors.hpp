// What can go wrong in an evaluation; Python repeats the evaluation for the full message.
#pragma once

namespace srm {

enum class Failure {
    not_finite,
    mass_matrix,
    closures,
    acceleration,
    no_branch,
    rotation,
    coincident,
};

struct EvaluationError {
    Failure why;
};

}  // namespace srm
