#pragma once

// Reads scene files (docs/scene.md).

#include <string>

#include "c_interface/scene.h"

namespace v3dg {

// Returns whether a file name is that of a scene.
bool is_scene_name(const std::string& path);

// Reads a scene, with all files to which it refers. Throws Fault, whose message names
// the file and the place in it.
SceneContent read_scene_file(const std::string& path);

}  // namespace v3dg
