#include "pipeline/scene_frame_cuda.h"

#include <algorithm>

#include "base/launch.cuh"

namespace v3dg {
namespace cuda {

FrameImage frame_image(const Pinhole<float>& camera, int width, int height, const float background[3],
                       float* color, float* alpha, float* depth) {
    return {camera,
            width,
            height,
            (width + kFrameTileWidth - 1) / kFrameTileWidth,
            (height + kFrameTileHeight - 1) / kFrameTileHeight,
            0,
            {background[0], background[1], background[2]},
            color,
            alpha,
            depth};
}

static uint32_t num_tiles(const FrameImage& image) {
    return static_cast<uint32_t>(image.tile_columns) * static_cast<uint32_t>(image.tile_rows);
}

PackedModel::PackedModel(const GaussianRows<const float>& rows, cudaStream_t stream)
    : rows_(rows), planes_(16 * rows.size, stream), packed_(pack(rows, planes_.data(), stream)) {}

DevicePalette::DevicePalette(Span<const float> sh, std::shared_ptr<const BundleTables> tables,
                             cudaStream_t stream)
    : tables_(std::move(tables)), sh_(sh, stream) {}

Palette DevicePalette::palette() const {
    return {sh_.data(), tables_->on_device().pages.first_row.data,
            static_cast<uint32_t>(tables_->num_clusters())};
}

void SceneFrame::set_models(std::vector<std::shared_ptr<const PackedModel>> models,
                            std::vector<std::shared_ptr<const DevicePalette>> palettes, cudaStream_t stream) {
    std::vector<GaussianRows<const float>> rows;
    std::vector<PackedPlanes> packed;
    for (size_t b = 0; b < models.size(); ++b) {
        rows.push_back(models[b]->rows());
        packed.push_back(models[b]->packed());
        if (!palettes.empty()) packed.back().palette = palettes[b]->palette();
    }
    rows_.copy_from({rows.data(), rows.size()}, stream);
    packed_.copy_from({packed.data(), packed.size()}, stream);
    models_ = std::move(models);
    palettes_ = std::move(palettes);
}

std::unique_ptr<Drawing> SceneFrame::draw(const SceneTables& scene, const FrameImage& image,
                                          Frame::Prepare prepare, cudaStream_t stream) {
    const FrameBatch batch{rows_.data(),
                           placements_.reserve(scene.num_instances(), stream),
                           images_.reserve(1, stream),
                           1,
                           num_tiles(image),
                           packed_.data(),
                           scene.num_instances() > 1,
                           image.min_transmittance};
    return frame_.draw(batch, std::move(prepare), stream);
}

std::unique_ptr<Drawing> SceneFrame::draw(const SceneTables& scene, const Camera& camera,
                                          const SelectRule& rule, const FrameImage& image,
                                          cudaStream_t stream) {
    return draw(
        scene, image,
        [=, &scene](const ItemList& items, cudaStream_t on) {
            cut_.cut_items(scene, camera, rule, image, images_.data(), placements_.data(), items, on);
        },
        stream);
}

std::unique_ptr<Drawing> SceneFrame::draw_cut(const SceneTables& scene, const Camera& camera,
                                              Span<const int32_t> instance, Span<const int32_t> cluster,
                                              const FrameImage& image, cudaStream_t stream) {
    return draw(
        scene, image,
        [=, &scene](const ItemList& items, cudaStream_t on) {
            cut_.given_items(scene, camera, instance, cluster, image, images_.data(), placements_.data(),
                             items, on);
        },
        stream);
}

constexpr unsigned kModelThreads = 128;

// A thread an item.
static __global__ void model_kernel(ModelTables tables, ModelTables* on_device, Appearance<float> appearance,
                                    ItemList items) {
    const unsigned long long i = blockIdx.x * static_cast<unsigned long long>(blockDim.x) + threadIdx.x;
    const unsigned long long first = i * kItemSize, count = tables.rows.size;
    if (i == 0) {
        *on_device = tables;
        items.counters->items = (count + kItemSize - 1) / kItemSize;
        items.counters->gaussians = count;
    }
    if (first >= count || i >= items.item_capacity || count > items.record_capacity) return;
    const uint32_t at = static_cast<uint32_t>(first);
    const uint32_t size =
        static_cast<uint32_t>(min(static_cast<unsigned long long>(kItemSize), count - first));
    items.items[i] = {0, at, size, at, appearance, 0};
}

std::unique_ptr<Drawing> ModelFrame::draw(const GaussianRows<const float>& rows, const ModelView<float>& view,
                                          float filter_px2, bool antialiased, const FrameImage& image,
                                          cudaStream_t stream, const PackedPlanes* packed) {
    if (tables_.data() == nullptr) tables_.reserve(1, stream);
    ModelTables* on_device = tables_.data();
    const ModelTables tables{rows, packed == nullptr ? PackedPlanes{} : *packed, {view, 0, 0}, image};
    const FrameBatch batch{&on_device->rows,
                           &on_device->placement,
                           &on_device->image,
                           1,
                           num_tiles(image),
                           packed == nullptr ? nullptr : &on_device->packed,
                           false,
                           image.min_transmittance};
    const unsigned blocks = std::max(1u, blocks_for(blocks_for(rows.size, kItemSize), kModelThreads));
    return frame_.draw(
        batch,
        [=](const ItemList& items, cudaStream_t on) {
            launch("model_kernel", model_kernel, blocks, kModelThreads, 0, on, tables, on_device,
                   Appearance<float>{filter_px2, antialiased}, items);
        },
        stream);
}

}  // namespace cuda
}  // namespace v3dg
