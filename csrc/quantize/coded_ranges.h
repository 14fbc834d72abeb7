#pragma once

// The ranges of a cluster, in the layout of a page.

#include <cstring>

#include "quantize/quantize_math.h"

namespace v3dg {

// The ranges of a cluster, as stored in a page.
struct CodedRanges {
    ClusterCode code{};
    uint16_t sh_steps[9]{};
};

// Returns the ranges in the form that decoding uses.
inline ClusterRanges decoded(const CodedRanges& coded, int sh_degree) {
    return ranges_of(coded.code, coded.sh_steps, sh_degree);
}

}  // namespace v3dg
