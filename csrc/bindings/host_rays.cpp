// Casts rays on the host, one pose after another.

#include "bindings/host_frame.h"
#include "bindings/rays.h"
#include "camera/camera_arrays.h"
#include "draw/seen_instances.h"

namespace v3dg::host {

namespace {

// Returns the camera of a pose, which has the density of the sensor's rays.
Camera camera_at(const backend::CastInput& input, size_t pose) {
    const double focal = 1.0 / input.sensor.limits.spacing;
    const double K[9] = {focal, 0, 0, 0, focal, 0, 0, 0, 1};
    const auto* viewmats = static_cast<const double*>(input.viewmats.data);
    return camera_of(viewmats + 16 * pose, K, 1, 1, input.sensor.limits.nearest);
}

class HostRayFrame final : public backend::RayFrame {
  public:
    void set_models(std::vector<std::shared_ptr<const backend::Model>> models,
                    const Work&) override {
        models_ = std::move(models);
    }

    std::vector<int64_t> cast_scene(const backend::Scene&, const SceneState& state,
                                    const backend::CastInput& input, const Work&) override {
        std::vector<SceneModel> drawn;
        for (size_t b = 0; b < state.tables.size(); ++b) {
            const auto& model = static_cast<const HostModel&>(*models_[b]);
            drawn.push_back({.planes = model.planes(),
                             .appearance = state.bundle(b).appearance(),
                             .palette = {},
                             .codes = model.codes()});
        }
        const v3dg::HostScene scene{.tables = {state.tables.data(), state.tables.size()},
                                    .models = {drawn.data(), drawn.size()},
                                    .instances = state.instances};
        std::vector<int64_t> gaussians;
        const auto* environments = static_cast<const int32_t*>(input.environments.data);
        for (size_t pose = 0; pose < input.num_poses; ++pose) {
            if (environments == nullptr) {
                gaussians.push_back(cast_at(scene, input, pose));
                continue;
            }
            const SeenInstances seen(state.instances, state.environments->table(),
                                     environments[pose]);
            gaussians.push_back(cast_at(seen.part_of(scene), input, pose));
        }
        return gaussians;
    }

    std::vector<int64_t> cast_model(const backend::Model& model,
                                    const Appearance<float>& appearance,
                                    const backend::CastInput& input, const Work&) override {
        const auto& of_host = static_cast<const HostModel&>(model);
        for (size_t pose = 0; pose < input.num_poses; ++pose) {
            const Draw<float> draw{.model = of_host.planes(),
                                   .first = 0,
                                   .count = of_host.size(),
                                   .view = view_of_world<float>(camera_at(input, pose)),
                                   .appearance = appearance};
            cpu::cast_rays({draw}, input.sensor.grid->directions(), input.sensor.limits,
                           planes_at(input, pose));
        }
        return std::vector<int64_t>(input.num_poses, static_cast<int64_t>(of_host.size()));
    }

  private:
    static int64_t cast_at(const v3dg::HostScene& scene, const backend::CastInput& input,
                           size_t pose) {
        return cpu::cast_scene(scene, input.sensor, camera_at(input, pose), input.rule,
                               planes_at(input, pose));
    }
    static RayPlanes planes_at(const backend::CastInput& input, size_t pose) {
        return input.planes.from(pose * input.sensor.grid->directions().num_rays());
    }

    std::vector<std::shared_ptr<const backend::Model>> models_;
};

}  // namespace

std::unique_ptr<backend::RayFrame> make_ray_frame() { return std::make_unique<HostRayFrame>(); }

}  // namespace v3dg::host
