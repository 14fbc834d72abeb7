#pragma once

// The rows of a .ply text file: one thread separates lines, all threads convert their
// numbers.

#include <cstddef>

#include "io/ply.h"

namespace v3dg {

// Reads the gaussians from `begin` on, as many as `out` has room for, and returns the
// place of the next one. Throws PlyError and std::system_error.
PlyPlace read_text(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out);

// Returns the offset behind the element that begins at `offset`. Throws likewise.
size_t skip_text(const PlyFile& ply, const PlyElement& element, size_t offset);

}  // namespace v3dg
