// Failures of an evaluation; the reference repeats the evaluation and has the full message.
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
