#pragma once

// Reads the rows of a .ply text file. One thread separates the lines, all threads
// convert their numbers.

#include <cstddef>

#include "io/ply.h"

namespace v3dg {

// Reads gaussians from `begin` on, as many as `out` has room for. Returns the place of
// the next gaussian. Throws PlyError and std::system_error.
PlyPlace read_text(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out);

// Returns the offset of the end of the element that begins at `offset`. Throws PlyError
// and std::system_error.
size_t skip_text(const PlyFile& ply, const PlyElement& element, size_t offset);

}  // namespace v3dg
