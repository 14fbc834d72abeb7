#pragma once

// Scenes: bundles, instances, cameras, and which pages are resident.

#include <memory>
#include <string>
#include <vector>

#include <v3dg.h>
#include "c_interface/bundle.h"
#include "residency/instance_columns.h"

namespace v3dg {

using SharedBundle = std::shared_ptr<const OpenBundle>;

struct NamedCamera {
    std::string name;
    v3dg_camera camera;
};

// The content of a scene's file. All values are checked, and quaternions have length 1.
struct SceneContent {
    std::vector<SharedBundle> bundles;  // in the order of their first instances
    std::vector<v3dg_instance> instances;
    std::vector<NamedCamera> cameras;
    std::string up;  // the axis that points up, or empty
};

// Returns the instances of a scene in the form that the core reads.
InstanceColumns columns_of(const std::vector<v3dg_instance>& instances);

}  // namespace v3dg

struct v3dg_scene {
    v3dg::SceneContent content;
    v3dg::InstanceColumns columns;
    // For each bundle, 0 for resident pages and v3dg::kAbsentPage for others. It is
    // empty if all pages are resident.
    std::vector<std::vector<int64_t>> page_shift;
    uint64_t revision = 0;  // identifies the instances; different for every scene
};
