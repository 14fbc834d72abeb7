#pragma once

// Reads the rows of a .ply text file. One thread separates the lines, and all threads
// convert their numbers.

#include <cstddef>

#include "io/ply.h"

namespace v3dg {

// Reads as many gaussians as `out` has room for, beginning at `begin`. Returns the
// place of the next gaussian. Throws PlyError and std::system_error.
PlyPlace read_text(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out);

// Returns the offset of the end of the element that begins at `offset`. Throws PlyError
// and std::system_error.
size_t skip_text(const PlyFile& ply, const PlyElement& element, size_t offset);

}  // namespace v3dg
