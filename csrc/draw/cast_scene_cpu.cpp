#include "draw/cast_scene.h"

#include "base/clock.h"
#include "draw/cut_draws.h"
#include "select/select.h"

namespace v3dg {

CastCounts cpu::cast_scene(const HostScene& scene, const RaySensor& sensor, const Camera& camera,
                           SelectRule rule, const RayPlanes& planes) {
    const double start = now();
    rule.culls = false;
    SelectOutput cut;
    cpu::select(
        {.bundles = scene.tables, .instances = scene.instances, .eyes = camera, .rule = rule}, cut);
    const double select_seconds = now() - start;
    const CutDraws draws(scene, camera, pairs_of(cut));
    return {.gaussians = cut.num_gaussians,
            .tolerance_px2 = cut.tolerance_px2,
            .select_seconds = select_seconds,
            .rays = cast_rays(draws.draws(), sensor.grid->directions(), sensor.limits, planes)};
}

}  // namespace v3dg
