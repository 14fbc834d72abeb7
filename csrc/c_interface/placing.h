#pragma once

// The poses of instances: checks, and the arithmetic of rotations.

#include <array>
#include <string>

#include <v3dg.h>

namespace v3dg {

using Quaternion = std::array<double, 4>;  // w, x, y, z

constexpr int32_t kSharedEnvironment = -1;
constexpr int32_t kMostEnvironment = (1 << 24) - 1;

// Returns the names of all axes for messages: 'x' or 'y' ...
std::string names_of_axes();
bool is_axis(const std::string& name);

// Returns a quaternion of length 1. Precondition: `quaternion` is finite and not zero.
Quaternion normalised(const Quaternion& quaternion);

// Returns the rotation that applies `second` first, and then `first`.
Quaternion product(const Quaternion& first, const Quaternion& second);

// Returns the rotation from one axis to another. If both are y or z, it is a rotation
// about x.
Quaternion turn_between(const std::string& up, const std::string& target);

// Returns an instance with a quaternion of length 1. Throws Fault for a value that
// v3dg_instance does not allow. `name` is the name of the instance in messages.
v3dg_instance checked_instance(const v3dg_instance& instance, const std::string& name);

// Returns `inner`, with the pose that results from placing its scene like `outer`. The
// bundle is that of `inner`. Throws Fault if the result is not allowed.
v3dg_instance composed(const v3dg_instance& outer, const v3dg_instance& inner,
                       const std::string& name);

// Sets position, quaternion and scale from a row-major matrix for column vectors.
// Throws Fault unless it is a rotation, a translation and a uniform scale.
void set_similarity(const double matrix[16], v3dg_instance& instance);

}  // namespace v3dg
