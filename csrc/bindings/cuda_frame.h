#pragma once

// Models, scenes, pools and frames on CUDA devices. Only source files of the CUDA
// backend include this file.

#include "bindings/resident.h"
#include "draw/scene_frame_cuda.h"

namespace v3dg::cuda {

// Returns the stream of a Work as a cudaStream_t.
inline cudaStream_t stream_of(const Work& work) { return static_cast<cudaStream_t>(work.stream()); }

// Borrows an array that is on any CUDA device.
Borrowed borrow_anywhere(const py::handle& array, const char* name, const Element& element,
                         const Shape& shape);

class BackendTables final : public backend::Tables {
  public:
    BackendTables(const BoundTable& table, const Work& work)
        : tables(table.table(), table.appearance(), stream_of(work)) {}
    size_t bytes() const override { return tables.bytes(); }

    const BundleTables tables;
};

// Returns the tables of a bundle on the device. They exist as long as the returned
// pointer.
std::shared_ptr<const BundleTables> tables_on(const BoundTable& table, const Work& work);

std::shared_ptr<const backend::Model> make_model(const Rows& rows, const Work& work);
std::shared_ptr<const backend::Model> make_model(const py::object& codes, const Work& work);
std::shared_ptr<const backend::Palette> make_palette(const py::object& table, const py::array& sh,
                                                     const Work& work);
std::unique_ptr<backend::Scene> make_scene();
std::unique_ptr<backend::Pool> make_pool(PagePool& pool, const py::list& tables, const Work& work);
std::unique_ptr<backend::Frame> make_frame(const Work& work);
std::unique_ptr<backend::AssetFrame> make_asset_frame(std::shared_ptr<const backend::Model> model,
                                                      Appearance<float> appearance,
                                                      const Work& work);

std::unique_ptr<backend::RayFrame> make_ray_frame();

// Return the objects of the core that handles own.
const SceneTables& tables_of(const backend::Scene& scene);
const DeviceModel& model_on_device(const backend::Model& model);

// Returns the image of a camera.
FrameImage image_of(const Camera& eye, const Shade& shade, const PicturePlanes& planes = {});

// Implements Backend::rasterize().
Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                     bool with_depth, bool keep_tape);

}  // namespace v3dg::cuda
