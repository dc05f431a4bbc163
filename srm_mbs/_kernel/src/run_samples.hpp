// Samples of a run, at which its accuracy is measured: run_samples.py.
#pragma once

#include <vector>

#include "dense.hpp"
#include "struct_fields.hpp"

namespace srm {

#define SRM_SAMPLE_RULES(field)                                                          \
    field(int, most_ends)         /* groups of steps of which one end each is sampled */ \
    field(int, even_times)        /* times between, where dense output takes no stage */ \
    field(std::vector<int>, fewest) /* steps to read in else, by error, by length and */ \
    field(std::vector<int>, one_of) /* at even distances: their number, its part, and */ \
    field(std::vector<int>, most)   /* the largest number */                             \
    field(std::vector<double>, read_at) /* fractions of these steps */

// Where a run is sampled.
struct SampleRules {
    SRM_FIELDS(SRM_SAMPLE_RULES)

    void check() const;
};

// RunSamples of run_samples.py, without the states.
struct SampleTimes {
    std::vector<double> t;
    std::vector<long> ends;
    std::size_t whole = 0;
};

// unit (n,): of the corrections; stages: whether dense output takes further ones.
SampleTimes sample_times(const StepArrays& steps, const SampleRules& rules,
                         const std::vector<double>& unit, bool stages);

}  // namespace srm
