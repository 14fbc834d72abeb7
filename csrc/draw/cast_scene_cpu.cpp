#include "draw/cast_scene.h"

#include "base/clock.h"
#include "select/select.h"

namespace v3dg {

namespace {

// Returns the selected clusters as draws. Neighbouring clusters of an instance that are
// drawn alike are one draw.
std::vector<Draw<float>> draws_of(const HostScene& scene, const Camera& camera,
                                  const SelectOutput& cut) {
    std::vector<Draw<float>> draws;
    int32_t last_instance = -1;
    ModelView<float> view{};
    for (size_t s = 0; s < cut.instance.size(); ++s) {
        const int32_t i = cut.instance[s];
        const int32_t bundle = scene.instances.bundle[i];
        const SceneModel& model = scene.models[bundle];
        const ClusterTable& table = scene.tables[bundle];
        const auto cluster = static_cast<size_t>(cut.cluster[s]);
        if (i != last_instance) {
            const Pose pose = scene.instances.pose(i);
            view = model_view_from_instance(axes_of_instance(camera, pose), pose);
        }
        const bool fades = !cut.weight.empty();
        const Span<const InstanceFactors>& factors = scene.instances.factors;
        const float weight = fades ? cut.weight[s] : 1.0f;
        const Draw<float> next{.model = model.planes,
                               .first = static_cast<uint64_t>(table.first_row(cluster)),
                               .count = static_cast<uint64_t>(table.num_gaussians(cluster)),
                               .view = view,
                               .appearance = fades ? model.appearance.faded(table, cluster)
                                                   : model.appearance[cluster],
                               .palette = model.palette,
                               .codes = model.codes,
                               .weight = factors.empty() ? weight : weight * factors[i].opacity,
                               .color_factors = factors.empty() ? nullptr : factors[i].color};
        const bool joins =
            i == last_instance && draws.back().first + draws.back().count == next.first &&
            draws.back().appearance == next.appearance && draws.back().weight == next.weight;
        if (joins)
            draws.back().count += next.count;
        else
            draws.push_back(next);
        last_instance = i;
    }
    return draws;
}

}  // namespace

CastCounts cpu::cast_scene(const HostScene& scene, const RaySensor& sensor, SelectRule rule,
                           const RayPlanes& planes) {
    const double start = now();
    rule.culls = false;
    SelectOutput cut;
    cpu::select({.bundles = scene.tables,
                 .instances = scene.instances,
                 .eyes = sensor.camera,
                 .rule = rule},
                cut);
    const double select_seconds = now() - start;
    return {
        .gaussians = cut.num_gaussians,
        .tolerance_px2 = cut.tolerance_px2,
        .select_seconds = select_seconds,
        .rays = cast_rays(draws_of(scene, sensor.camera, cut), sensor.grid, sensor.limits, planes)};
}

}  // namespace v3dg
