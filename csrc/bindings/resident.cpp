// Models, palettes and scenes. These classes check arguments and call the backend.

#include "bindings/resident.h"

#include <algorithm>

namespace v3dg {

BoundModel::BoundModel(const Rows& rows) : device_(rows.device()), size_(rows.size()) {
    static_cast<void>(rows.read<float>());  // checks that the gaussians are float32
    const Work work(device_);
    model_ = work.backend().make_model(rows, work);
}

BoundModel::BoundModel(const py::object& codes, int device) : device_{device}, is_coded_(true) {
    const auto& given = held<BoundCodes>(codes, "codes");
    size_ = given.num_gaussians();
    const Work work(device_);
    const Codes& host = given.pages().codes();
    sh_degree_ = host.sh_degree;
    for (size_t c = 0; c < host.num_clusters(); ++c)
        num_gaussians_.push_back(static_cast<uint32_t>(host.offset[c + 1] - host.offset[c]));
    model_ = work.backend().make_model(codes, work);
}

py::tuple BoundModel::decode(const py::array& cluster_ids) const {
    if (!has_codes())
        throw py::value_error("decode: expected quantized gaussians, got float32 ones");
    const Span<const int32_t> cluster = span_of<const int32_t>(cluster_ids, "cluster_ids", {-1});
    std::vector<int64_t> offset{0};
    for (const int32_t c : cluster) {
        if (c < 0 || static_cast<size_t>(c) >= num_gaussians_.size())
            throw std::out_of_range("cluster_ids: expected ids of at least 0 and below " +
                                    std::to_string(num_gaussians_.size()) + ", got " +
                                    std::to_string(c));
        offset.push_back(offset.back() + num_gaussians_[c]);
    }
    const Work work(device_);
    const NewRows out(device_, static_cast<size_t>(offset.back()), sh_degree_);
    {
        const Unlocked unlocked;
        model_->decode(cluster, {offset.data(), offset.size()}, work, out.rows());
    }
    return out.arrays();
}

BoundPalette::BoundPalette(const py::object& table_object, const py::array& sh, int device)
    : device_{device} {
    const auto& table = held<BoundTable>(table_object, "table");
    const auto clusters = static_cast<py::ssize_t>(table.table().num_clusters());
    span_of<const float>(sh, "sh", {clusters, 3});
    const Work work(device_);
    palette_ = work.backend().make_palette(table_object, sh, work);
}

BoundScene::BoundScene(int device) : device_{device}, state_(std::make_shared<SceneState>()) {
    {
        const Work work(device_);
        scene_ = work.backend().make_scene(work);
    }
    set_bundles(py::list());
}

void BoundScene::set_bundles(const py::list& bundles) {
    auto state = std::make_shared<SceneState>();
    state->bundles = bundles;
    for (const py::handle& bundle : bundles) {
        const auto& table = held<BoundTable>(bundle, "tables");
        state->tables.push_back(table.table());
        state->num_gaussians.push_back(table.num_gaussians());
    }
    const Work work(device_);
    scene_->set_bundles(*state, work);
    state_ = std::move(state);
}

// Returns the environment of each instance. None means a scene without environments.
static std::vector<int32_t> environments_of(const py::object& environments, py::ssize_t count) {
    if (environments.is_none()) return std::vector<int32_t>(static_cast<size_t>(count), kShared);
    const Span<const int32_t> given = span_of<const int32_t>(environments, "environments", {count});
    for (const int32_t e : given)
        if (e < kShared || e > kMostEnvironment)
            refuse_value("environments", "expected -1 to " + std::to_string(kMostEnvironment) +
                                             ", got " + std::to_string(e));
    return {given.begin(), given.end()};
}

// Returns the label of each instance, or null for None.
static std::shared_ptr<const std::vector<int32_t>> labels_of(const py::object& labels,
                                                             py::ssize_t count) {
    if (labels.is_none()) return nullptr;
    const Span<const int32_t> given = span_of<const int32_t>(labels, "labels", {count});
    return std::make_shared<std::vector<int32_t>>(given.begin(), given.end());
}

void BoundScene::set_instances(const py::array& bundle, const py::array& importance,
                               const py::object& positions, const py::object& quaternions,
                               const py::object& scales, const py::object& factors,
                               const py::object& environments, const py::object& labels) {
    auto state = std::make_shared<SceneState>(*state_);
    InstanceTable& instances = state->instances;
    instances.bundle = span_of<const int32_t>(bundle, "bundle", {-1});
    check_instance_bundles(instances.bundle, state->tables.size());
    const auto count = static_cast<py::ssize_t>(instances.bundle.size);
    instances.importance = span_of<const float>(importance, "importance", {count});
    instances.factors = factors_of(factors, count);
    const std::vector<int32_t> environment = environments_of(environments, count);
    state->environments =
        std::make_shared<Environments>(Span<const int32_t>{environment.data(), environment.size()});
    state->labels = labels_of(labels, count);
    state->arrays = py::make_tuple(bundle, importance, positions, quaternions, scales, factors);
    const Work work(device_);
    scene_->set_instances(*state, work);
    state_ = std::move(state);
}

void BoundScene::set_poses(const py::object& positions, const py::object& quaternions,
                           const py::object& scales) {
    auto state = std::make_shared<SceneState>(*state_);
    state->arrays = py::make_tuple(state->arrays[0], state->arrays[1], positions, quaternions,
                                   scales, state->arrays[5]);
    const Work work(device_);
    scene_->set_poses(*state, work);
    state_ = std::move(state);
}

BoundCut BoundScene::select(const BoundEyes& camera, const SelectRule& rule, BudgetSteps* steps) {
    check_footprint(camera.eyes, rule);
    const std::shared_ptr<const SceneState> state = state_;
    const Work work(device_);
    const auto cut = [&](const SelectRule& paced, uint32_t* last_bin) {
        const Unlocked unlocked;
        SelectOutput out;
        scene_->select(*state, camera.eyes, paced, last_bin, work, out);
        return out;
    };
    return BoundCut(in_steps(steps, rule, camera.eyes, state, cut));
}

py::list BoundScene::page_needs(const BoundCamera& camera, const SelectRule& rule) const {
    check_is_on_host(device_, "page_needs",
                     "expected a scene on the CPU, got one on a CUDA device");
    const std::shared_ptr<const SceneState> state = state_;
    py::list priorities;
    std::vector<Span<uint32_t>> needs;
    for (const ClusterTable& table : state->tables) {
        const NewArray<float> priority(kHost, {static_cast<py::ssize_t>(table.num_pages())});
        std::fill(priority.span.begin(), priority.span.end(), 0.0f);
        needs.push_back({reinterpret_cast<uint32_t*>(priority.span.data), priority.span.size});
        priorities.append(priority.object);
    }
    SelectOutput out;
    const Unlocked unlocked;
    cpu::select({.bundles = {state->tables.data(), state->tables.size()},
                 .instances = state->instances,
                 .eyes = camera.camera,
                 .rule = rule,
                 .needs = {needs.data(), needs.size()}},
                out);
    return priorities;
}

}  // namespace v3dg
