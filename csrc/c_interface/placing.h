#pragma once

// The poses of instances: checks, and the arithmetic of rotations.

#include <array>
#include <string>

#include <v3dg.h>

namespace v3dg {

using Quaternion = std::array<double, 4>;  // w, x, y, z

constexpr int32_t kSharedEnvironment = -1;
constexpr int32_t kMostEnvironment = (1 << 24) - 1;

// Returns the names of axes as Python shows them: 'x' or 'y' ...
std::string names_of_axes();
bool is_axis(const std::string& name);

// Returns a quaternion of length one. Precondition: it is finite and not zero.
Quaternion normalised(const Quaternion& quaternion);

// Returns the rotation by `second`, then by `first`.
Quaternion product(const Quaternion& first, const Quaternion& second);

// Returns the rotation from one axis to another, about x if both are y or z.
Quaternion turn_between(const std::string& up, const std::string& target);

// Returns an instance with a quaternion of length one. Throws Fault for a value that
// v3dg_instance does not allow; `name` is the name of the instance in messages.
v3dg_instance checked_instance(const v3dg_instance& instance, const std::string& name);

// Returns `inner` after placing its whole scene like `outer`. The bundle is that of
// `inner`. Throws Fault if the result is not allowed.
v3dg_instance composed(const v3dg_instance& outer, const v3dg_instance& inner,
                       const std::string& name);

// Sets position, quaternion and scale from a row-major matrix for column vectors.
// Throws Fault unless it is a rotation, a translation and a uniform scale.
void set_similarity(const double matrix[16], v3dg_instance& instance);

}  // namespace v3dg
