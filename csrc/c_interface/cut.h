#pragma once

// Selection of cuts, and reading their gaussians.

#include <v3dg.h>
#include "c_interface/scene.h"
#include "camera/camera.h"

namespace v3dg {

// Returns the cut of a view. The caller must free it with free_cut(). Throws Fault for
// a rule that v3dg_rule does not allow, and if the coarsest cut exceeds the budget.
v3dg_cut* select_cut(const v3dg_scene& scene, const Eyes& eyes, const v3dg_rule& rule);
void free_cut(v3dg_cut* cut);

// Reads the gaussians of a cut, in world coordinates minus `origin`. Throws Fault if
// the cut belongs to other instances, and PageError if a page cannot be read.
void read_cut(const v3dg_scene& scene, const v3dg_cut& cut, const double origin[3],
              const v3dg_gaussians& out);

}  // namespace v3dg
