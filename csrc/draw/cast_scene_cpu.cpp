#include "draw/cast_scene.h"

#include "draw/cut_draws.h"
#include "select/select.h"

namespace v3dg {

int64_t cpu::cast_scene(const HostScene& scene, const RaySensor& sensor, const Camera& camera,
                        SelectRule rule, const RayPlanes& planes) {
    rule.culls = false;
    SelectOutput cut;
    cpu::select(
        {.bundles = scene.tables, .instances = scene.instances, .eyes = camera, .rule = rule}, cut);
    const CutDraws draws(scene, camera, pairs_of(cut));
    cast_rays(draws.draws(), sensor.grid->directions(), sensor.limits, planes);
    return cut.num_gaussians;
}

}  // namespace v3dg
