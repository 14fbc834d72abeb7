// Casts rays on CUDA devices.

#include "bindings/cuda_frame.h"
#include "bindings/rays.h"
#include "draw/cast_scene_cuda.h"

namespace v3dg::cuda {

namespace {

RayPoses poses_of(const backend::CastInput& input) {
    return {.viewmats = input.viewmats.data,
            .are_double = input.viewmats.are_double,
            .environments = input.environments.data,
            .are_environments_long = input.environments.are_long,
            .count = static_cast<uint32_t>(input.num_poses)};
}

class BackendRayFrame final : public backend::RayFrame {
  public:
    void set_models(std::vector<std::shared_ptr<const backend::Model>> models,
                    const Work& work) override {
        std::vector<DeviceModel> on_device;
        for (const std::shared_ptr<const backend::Model>& model : models)
            on_device.push_back(model_on_device(*model));
        frame_.set_models(std::move(on_device), stream_of(work));
        models_ = std::move(models);
    }

    std::vector<int64_t> cast_scene(const backend::Scene& scene, const SceneState&,
                                    const backend::CastInput& input, const Work& work) override {
        return frame_.cast_scene(tables_of(scene), input.sensor, poses_of(input), input.rule,
                                 input.planes, stream_of(work));
    }

    std::vector<int64_t> cast_model(const backend::Model& model,
                                    const Appearance<float>& appearance,
                                    const backend::CastInput& input, const Work& work) override {
        return frame_.cast_model(model_on_device(model).packed->rows(), appearance, input.sensor,
                                 poses_of(input), input.planes, stream_of(work));
    }

  private:
    // Models own the memory that the frame reads.
    std::vector<std::shared_ptr<const backend::Model>> models_;
    cuda::RayFrame frame_;
};

}  // namespace

std::unique_ptr<backend::RayFrame> make_ray_frame() { return std::make_unique<BackendRayFrame>(); }

}  // namespace v3dg::cuda
