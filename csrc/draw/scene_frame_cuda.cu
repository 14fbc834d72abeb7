// Implements scene_frame_cuda.h: enqueues the cut, which writes a frame's items, and
// sets the models of the batch.

#include "draw/scene_frame_cuda.h"

#include <algorithm>
#include <cstring>

#include "base/launch.cuh"

namespace v3dg {
namespace cuda {

FrameImage frame_image(const Intrinsics<float>& camera, int width, int height,
                       const float background[3], const PicturePlanes& planes) {
    return {.camera = camera,
            .width = width,
            .height = height,
            .tile_columns = (width + kFrameTileWidth - 1) / kFrameTileWidth,
            .tile_rows = (height + kFrameTileHeight - 1) / kFrameTileHeight,
            .first_tile = 0,
            .background = {background[0], background[1], background[2]},
            .planes = planes};
}

PackedModel::PackedModel(const GaussianRows<const float>& rows, cudaStream_t stream)
    : rows_(rows), planes_(16 * rows.size, stream), packed_(pack(rows, planes_.data(), stream)) {}

CodedModel::CodedModel(const CodedPages& pages, cudaStream_t stream) : codes_(pages.codes()) {
    constexpr size_t kWordsAtOnce = 4 << 20;
    const Codes& host = pages.codes();
    const auto num_rows = static_cast<size_t>(host.offset[host.offset.size - 1]);
    const size_t sh_words = num_sh_words(host.sh_degree);
    uint32_t* records = records_.reserve(kRecordWords * num_rows, stream);
    uint32_t* sh = sh_.reserve(sh_words * num_rows, stream);
    std::vector<uint32_t> next_records, next_sh;
    const auto add = [stream](std::vector<uint32_t>& words, const uint32_t* from, size_t count,
                              bool is_last, uint32_t*& to) {
        words.insert(words.end(), from, from + count);
        if (words.empty() || (words.size() < kWordsAtOnce && !is_last)) return;
        check(cudaMemcpyAsync(to, words.data(), words.size() * sizeof(uint32_t),
                              cudaMemcpyHostToDevice, stream),
              "cudaMemcpyAsync of codes");
        to += words.size();
        words.clear();
    };
    const size_t num_pages = pages.first_cluster().size - 1;
    for (size_t p = 0; p < num_pages; ++p) {
        const auto first = static_cast<size_t>(pages.first_cluster()[p]),
                   last = static_cast<size_t>(pages.first_cluster()[p + 1]);
        const auto row = static_cast<uint32_t>(host.offset[first]);
        const auto count = static_cast<size_t>(host.offset[last] - host.offset[first]);
        const ClusterRanges& own = host.ranges_of(static_cast<uint32_t>(first));
        add(next_records, host.record_of(own, row), kRecordWords * count, p + 1 == num_pages,
            records);
        add(next_sh, host.sh_of(own, row), sh_words * count, p + 1 == num_pages, sh);
    }
    std::vector<unsigned char> ranges(size_t(host.range_size) * host.num_clusters());
    for (uint32_t c = 0; c < host.num_clusters(); ++c) {
        ClusterRanges own{};
        std::memcpy(&own, &host.ranges_of(c), host.range_size);
        own.record_base = own.sh_base = 0;
        std::memcpy(ranges.data() + size_t(host.range_size) * c, &own, host.range_size);
    }
    codes_.records = records_.data();
    codes_.sh = sh_.data();
    codes_.ranges = ranges_.copy_from({ranges.data(), ranges.size()}, stream);
    codes_.offset.data = offset_.copy_from(host.offset, stream);
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

DevicePalette::DevicePalette(Span<const float> sh, std::shared_ptr<const BundleTables> tables,
                             cudaStream_t stream)
    : tables_(std::move(tables)), sh_(sh, stream) {}

Palette DevicePalette::palette() const {
    return {sh_.data(), tables_->on_device().table.offset.data,
            static_cast<uint32_t>(tables_->num_clusters())};
}

void SceneFrame::set_models(std::vector<DeviceModel> models,
                            std::vector<std::shared_ptr<const DevicePalette>> palettes,
                            cudaStream_t stream) {
    std::vector<GaussianRows<const float>> rows(models.size());
    std::vector<PackedPlanes> packed(models.size());
    std::vector<CodedGaussians> coded(models.size());
    has_packed_ = has_coded_ = false;
    for (size_t b = 0; b < models.size(); ++b) {
        const Palette palette = palettes.empty() ? Palette{} : palettes[b]->palette();
        if (models[b].coded != nullptr) {
            coded[b] = {models[b].coded->codes(), palette};
            has_coded_ = true;
        } else {
            rows[b] = models[b].packed->rows();
            packed[b] = models[b].packed->packed();
            packed[b].palette = palette;
            has_packed_ = true;
        }
    }
    rows_.copy_from({rows.data(), rows.size()}, stream);
    packed_.copy_from({packed.data(), packed.size()}, stream);
    coded_.copy_from({coded.data(), coded.size()}, stream);
    models_ = std::move(models);
    palettes_ = std::move(palettes);
}

EyeImages images_of_eyes(const FrameImage& left, FrameImage right, float min_transmittance) {
    right.first_tile = num_tiles_of(left);
    return {{left, right}, 2, min_transmittance};
}

ClippedPictures clipped_pictures(const Eyes& eyes, const EyeImages& pictures,
                                 const FrameSensors& sensors) {
    return {.sensors = sensors,
            .cameras = nullptr,
            .eye = {eyes.camera[0], eyes.camera[1]},
            .count = pictures.count,
            .width = pictures.image[0].width,
            .height = pictures.image[0].height};
}

DrawnModels SceneFrame::drawn_models() const {
    return {.rows = rows_.data(),
            .packed = has_packed_ ? packed_.data() : nullptr,
            .coded = has_coded_ ? coded_.data() : nullptr};
}

FrameBatch SceneFrame::batch(const SceneTables& scene, const EyeImages& pictures,
                             const SelectRule& rule, const FrameSensors& sensors,
                             cudaStream_t stream) {
    const FrameImage& last = pictures.image[pictures.count - 1];
    const Span<const InstanceFactors> factors = scene.on_device().instances.factors;
    return {.models = rows_.data(),
            .placements = placements_.reserve(pictures.count * scene.num_instances(), stream),
            .images = images_.reserve(pictures.count, stream),
            .num_images = pictures.count,
            .num_tiles = last.first_tile + num_tiles_of(last),
            .packed = has_packed_ ? packed_.data() : nullptr,
            .coded = has_coded_ ? coded_.data() : nullptr,
            .has_shared_items = scene.num_instances() > 1,
            .min_transmittance = rule.budget == kNoBudget
                                     ? stop_of_cut(pictures.min_transmittance, rule.tolerance_px2)
                                     : pictures.min_transmittance,
            .has_faded_items = rule.fade.is_on(),
            .has_lenses = !pictures.image[0].camera.is_pinhole(),
            .factors = factors.empty() ? nullptr : factors.data,
            .num_factors = static_cast<uint32_t>(factors.size),
            .guards_models = nullptr,
            .num_zeros = Cut::num_zeros(scene, rule),
            .has_depth = false,
            .sensors = sensors,
            .sensed_scene = {
                .scene = &scene,
                .num_slots = static_cast<uint32_t>(std::max<size_t>(scene.num_instances(), 1))}};
}

// Returns the rule for drawing a frame again after a buffer was too small.
static SelectRule drawn_again(SelectRule rule) {
    if (rule.pace == BudgetPace::in_steps) rule.pace = BudgetPace::again;
    return rule;
}

std::unique_ptr<Drawing> SceneFrame::draw(const SceneTables& scene, DevicePages* pages,
                                          const FrameRequest& request, SelectRule& rule,
                                          const EyeImages& pictures, const FrameSensors& sensors,
                                          cudaStream_t stream, const Frame::Place& place) {
    const Eyes& eyes = request.eyes;
    if (request.cut) return draw_given(scene, request, pictures, sensors, stream, place);
    if (pages != nullptr)
        return draw_resident(scene, *pages, eyes, rule, pictures, sensors, stream, place);
    return draw_selected(scene, eyes, rule, pictures, sensors, stream, place);
}

// Returns where a cut writes the tolerance of a budget; null without a budget.
static const CutChoice* choice_of(const SelectRule& rule, const ItemList& items) {
    return rule.budget == kNoBudget ? nullptr : &items.counters->choice;
}

std::unique_ptr<Drawing> SceneFrame::draw_selected(const SceneTables& scene, const Eyes& eyes,
                                                   const SelectRule& rule,
                                                   const EyeImages& pictures,
                                                   const FrameSensors& sensors, cudaStream_t stream,
                                                   const Frame::Place& place) {
    return frame_.draw(
        batch(scene, pictures, rule, sensors, stream),
        [=, this, &scene, next = rule](const ItemList& items, cudaStream_t on) mutable {
            cut_.cut_items(scene, eyes, next, pictures, images_.data(), placements_.data(), items,
                           on);
            if (sensors.wants_clipped())
                clipped_.mark_scene(scene, scene.seen_by_all(),
                                    clipped_pictures(eyes, pictures, sensors), drawn_models(), next,
                                    choice_of(next, items), on);
            next = drawn_again(next);
        },
        stream, place);
}

std::unique_ptr<Drawing> SceneFrame::draw_resident(const SceneTables& scene, DevicePages& pages,
                                                   const Eyes& eyes, SelectRule& rule,
                                                   const EyeImages& pictures,
                                                   const FrameSensors& sensors, cudaStream_t stream,
                                                   const Frame::Place& place) {
    const StreamLock lock(pages.mutex(), stream);
    const Arrive arrive = rule.fade.is_on() ? Arrive::fading : Arrive::at_once;
    PartlyResident resident = pages.begin_frame(true, arrive, stream);
    SelectRule next = rule = pages.raised(rule);
    FrameBatch of_pages = batch(scene, pictures, rule, sensors, stream);
    of_pages.models = nullptr;  // slots of a pool have no rows
    of_pages.packed = pages.packed();
    of_pages.coded = pages.coded();
    of_pages.guards_models = &pages.mutex();
    return frame_.draw(
        of_pages,
        [=, this, &scene, &pages](const ItemList& items, cudaStream_t on) mutable {
            cut_.cut_items(scene, eyes, next, pictures, images_.data(), placements_.data(), items,
                           on, &resident);
            if (sensors.wants_clipped())
                clipped_.mark_scene(scene, scene.seen_by_all(),
                                    clipped_pictures(eyes, pictures, sensors),
                                    {nullptr, pages.packed(), pages.coded()}, next,
                                    choice_of(next, items), on, &resident);
            next = drawn_again(next);
            // A frame that is drawn again must not report page requests, because the
            // next frame may already be reporting its own.
            if (resident.needs.report != nullptr) pages.end_frame(on);
            resident.needs = {};
        },
        stream, place);
}

std::unique_ptr<Drawing> SceneFrame::draw_given(const SceneTables& scene,
                                                const FrameRequest& request,
                                                const EyeImages& pictures,
                                                const FrameSensors& sensors, cudaStream_t stream,
                                                const Frame::Place& place) {
    const GivenCut given = *request.cut;
    const float tolerance_px2 = request.rule.tolerance_px2;
    FrameBatch of_cut =
        batch(scene, pictures, SelectRule{.tolerance_px2 = tolerance_px2}, sensors, stream);
    of_cut.has_faded_items = given.weight.size > 0;
    return frame_.draw(
        of_cut,
        [=, this, &scene, camera = request.eyes.camera[0]](const ItemList& items, cudaStream_t on) {
            cut_.given_items(scene, camera, given, pictures.image[0], images_.data(),
                             placements_.data(), items, on);
            if (sensors.wants_clipped())
                clipped_.mark_given(scene, clipped_pictures(camera, pictures, sensors),
                                    drawn_models(), given, on);
        },
        stream, place);
}

std::vector<std::pair<const char*, size_t>> SceneFrame::bytes() const {
    auto parts = frame_.bytes();
    const size_t tables = rows_.bytes() + packed_.bytes() + coded_.bytes() + images_.bytes();
    parts.emplace_back("placements", placements_.bytes() + factors_.bytes() + tables);
    parts.emplace_back("cut", cut_.bytes() + clipped_.bytes());
    return parts;
}

constexpr unsigned kModelThreads = 128;

// Launched with one thread per item.
static __global__ void model_kernel(ModelTables tables, ModelTables* on_device,
                                    Appearance<float> appearance, ItemList items) {
    const unsigned long long i =
        blockIdx.x * static_cast<unsigned long long>(blockDim.x) + threadIdx.x;
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
    items.items[i] = {0, at, size, at, appearance, 0, 0, 1.0f};
}

std::unique_ptr<Drawing> ModelFrame::draw(const GaussianRows<const float>& rows,
                                          const ModelView<float>& view, float filter_px2,
                                          bool antialiased, const FrameImage& image,
                                          cudaStream_t stream, const PackedPlanes* packed,
                                          float min_transmittance, const Frame::Place& place,
                                          const FrameSensors& sensors,
                                          const ClippedPictures& clipped) {
    if (tables_.data() == nullptr) tables_.reserve(1, stream);
    ModelTables* on_device = tables_.data();
    const ModelTables tables{
        rows, packed == nullptr ? PackedPlanes{} : *packed, {view, 0, 0}, image};
    const FrameBatch batch{.models = &on_device->rows,
                           .placements = &on_device->placement,
                           .images = &on_device->image,
                           .num_images = 1,
                           .num_tiles = num_tiles_of(image),
                           .packed = packed == nullptr ? nullptr : &on_device->packed,
                           .min_transmittance = min_transmittance,
                           .has_lenses = !image.camera.is_pinhole(),
                           .has_depth = image.planes.depth != nullptr,
                           .sensors = sensors};
    const unsigned blocks =
        std::max(1u, blocks_for(blocks_for(rows.size, kItemSize), kModelThreads));
    return frame_.draw(
        batch,
        [=](const ItemList& items, cudaStream_t on) {
            launch("model_kernel", model_kernel, blocks, kModelThreads, 0, on, tables, on_device,
                   Appearance<float>{filter_px2, antialiased, false}, items);
            const DrawnModels models{batch.models, batch.packed, nullptr};
            if (clipped.is_on())
                ClippedPass::mark_model(clipped, models, view, tables.rows.size, on);
        },
        stream, place);
}

}  // namespace cuda
}  // namespace v3dg
