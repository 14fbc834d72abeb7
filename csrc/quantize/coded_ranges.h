#pragma once

// The ranges of a cluster as a page has them.

#include <cstring>

#include "quantize/quantize_math.h"

namespace v3dg {

// A cluster's ranges as they are in a page.
struct CodedRanges {
    ClusterCode code{};
    uint16_t sh_steps[9]{};
};

// Returns what gaussians of the cluster are decoded with.
inline ClusterRanges decoded(const CodedRanges& coded, int sh_degree) {
    return ranges_of(coded.code, coded.sh_steps, sh_degree);
}

}  // namespace v3dg
