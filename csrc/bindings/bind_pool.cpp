// Bindings of page pools and their sources (residency/page_pool.h).

#include <algorithm>
#include <thread>

#include "base/parallel_for.h"
#include "bindings/operations.h"
#include "bindings/pool.h"

namespace v3dg {

namespace {

// Pages that are being read may use up to 1 / kBlockShare of a pool's memory.
constexpr size_t kBlockShare = 8;
// Maximum number of threads that read pages. They also compute hashes, so more cores
// help.
constexpr unsigned kMostThreads = 16;

[[noreturn]] void raise(const PageError& error) {
    PyErr_SetString(error.is_damage ? PyExc_ValueError : PyExc_OSError, error.what());
    throw py::error_already_set();
}

// The file of a bundle, and the arrays with the locations and hashes of its pages.
struct BoundFileSource {
    std::string name;
    int descriptor;
    PageCodec codec;
    int sh_degree;
    py::array places, hashes;
    py::object fetch;  // a function that fetches parts of the file, or None
};

PageCodec codec_of(const std::string& name) {
    if (name == "float32") return PageCodec::float32;
    if (name == "quantized") return PageCodec::quantized;
    throw py::value_error("codec: expected float32 or quantized, got " + name);
}

// The source of the pages of a bundle, borrowed from Python objects. Either `rows` or
// `file` is set.
struct GivenSource {
    const Rows* rows = nullptr;             // pages in memory, or null
    const BoundFileSource* file = nullptr;  // pages in a file, or null
    Fetch fetch = {};
    Span<const int64_t> places = {};
    Span<const uint8_t> hashes = {};
};

// Returns the text of the current Python error, and clears the error. The caller must
// hold the GIL.
std::string text_of_error() {
    PyObject *type = nullptr, *value = nullptr, *trace = nullptr;
    PyErr_Fetch(&type, &value, &trace);
    PyErr_NormalizeException(&type, &value, &trace);
    PyObject* const text = value == nullptr ? nullptr : PyObject_Str(value);
    const char* const bytes = text == nullptr ? nullptr : PyUnicode_AsUTF8(text);
    std::string problem = bytes == nullptr ? "" : bytes;
    PyErr_Clear();
    for (PyObject* object : {type, value, trace, text}) Py_XDECREF(object);
    return problem.empty() ? "the fetch failed" : problem;
}

// Calls a Python function that fetches parts of a file. Returns the text of its error,
// or an empty string. The caller must hold the GIL. Local objects must not have
// destructors that need the GIL, because Python may end the thread during the call.
std::string told_by(PyObject* function, Span<const int64_t> places) {
    PyObject* const list = PyList_New(static_cast<py::ssize_t>(places.size / 2));
    for (size_t k = 0; list != nullptr && k < places.size / 2; ++k)
        PyList_SET_ITEM(list, static_cast<py::ssize_t>(k),
                        Py_BuildValue("(LL)", static_cast<long long>(places[2 * k]),
                                      static_cast<long long>(places[2 * k + 1])));
    PyObject* const done =
        list == nullptr ? nullptr : PyObject_CallFunctionObjArgs(function, list, nullptr);
    Py_XDECREF(list);
    Py_XDECREF(done);
    return done == nullptr ? text_of_error() : std::string();
}

// Wraps a Python function for threads that Python did not start. Such a thread acquires
// the GIL for the call, so a thread that waits for it must release the GIL first. The
// function is never destroyed, because a pool may leave threads behind that call it.
Fetch fetch_by(const py::object& function) {
    if (function.is_none()) return {};
    PyObject* const kept = function.inc_ref().ptr();
    return [kept](Span<const int64_t> places) -> std::string {
        std::string problem;
        const bool was_called = call_with_lock([&] { problem = told_by(kept, places); });
        return was_called ? problem : "the process ends";
    };
}

GivenSource given_source(const py::handle& source, const ClusterTable& table) {
    if (py::isinstance<Rows>(source)) return {.rows = &source.cast<const Rows&>()};
    const auto& file = held<BoundFileSource>(source, "sources");
    const auto num_pages =
        static_cast<py::ssize_t>(table.num_clusters() > 0 ? table.num_pages() : 0);
    return {.file = &file,
            .fetch = fetch_by(file.fetch),
            .places = span_of<const int64_t>(file.places, "places", {num_pages + 1}),
            .hashes = span_of<const uint8_t>(file.hashes, "hashes", {num_pages, 16})};
}

std::shared_ptr<const PageSource> source_of(const GivenSource& given, const ClusterTable& table) {
    if (given.rows != nullptr)
        return std::make_shared<MemoryPages>(table, given.rows->read<float>());
    const BoundFileSource& file = *given.file;
    return std::make_shared<FilePages>(table, file.sh_degree, file.codec, file.name,
                                       file.descriptor, given.places, given.hashes, given.fetch);
}

py::array_t<bool> resident_pages(BoundPool& pool, size_t bundle) {
    if (bundle >= pool.pool().num_bundles())
        throw py::value_error("bundle: expected an index below " +
                              std::to_string(pool.pool().num_bundles()) + ", got " +
                              std::to_string(bundle));
    const Span<const int64_t> shift = pool.pool().shift(bundle);
    py::array_t<bool> there(static_cast<py::ssize_t>(shift.size));
    std::transform(shift.begin(), shift.end(), there.mutable_data(),
                   [](int64_t s) { return s != kAbsentPage; });
    return there;
}

py::array_t<int32_t> arrived_pages(BoundPool& pool, size_t bundle) {
    const py::ssize_t num_pages = resident_pages(pool, bundle).size();
    const PageTable pages{pool.pool().shift(bundle), {}, pool.pool().begins(bundle)};
    py::array_t<int32_t> arrived(num_pages);
    for (py::ssize_t p = 0; p < num_pages; ++p)
        arrived.mutable_data()[p] =
            pages.is_resident(p) ? pages.arrived(p, pool.pool().arrivals().frame()) : 0;
    return arrived;
}

}  // namespace

BoundPool::BoundPool(const py::list& tables, const py::list& sources, int device, size_t num_bytes,
                     unsigned num_threads)
    : device_{device}, tables_(tables), sources_(sources) {
    std::vector<PagedBundle> bundles;
    std::vector<GivenSource> given;
    for (size_t b = 0; b < tables.size(); ++b) {
        bundles.push_back({held<BoundTable>(tables[b], "tables").table(), nullptr});
        given.push_back(given_source(sources[b], bundles[b].table));
    }
    {
        const Unlocked unlocked;
        parallel_for(bundles.size(), 1,
                     [&](size_t b) { bundles[b].source = source_of(given[b], bundles[b].table); });
    }
    int max_degree = 0;
    PoolLimits limits{};
    limits.keeps_codes = !bundles.empty();
    for (const PagedBundle& bundle : bundles) {
        max_degree = std::max(max_degree, bundle.source->sh_degree());
        limits.keeps_codes &= bundle.source->codec() == PageCodec::quantized;
    }
    limits.num_threads = num_threads;
    if (num_threads > 0)
        limits.num_threads =
            std::max(num_threads, std::min(kMostThreads, std::thread::hardware_concurrency()));
    const Work work(device_);
    PoolDemands demands = work.backend().pool_demands(max_degree);
    limits.most_frames = demands.most_frames;
    limits.block_bytes = std::min(demands.most_block_bytes, num_bytes / kBlockShare);
    limits.memory = {num_bytes - limits.block_bytes, demands.row_bytes, 0};
    if (limits.keeps_codes) {
        limits.memory.row_bytes = slot_row_bytes(max_degree);
        limits.memory.cluster_bytes = slot_cluster_bytes(max_degree);
        if (demands.most_coded_rows > 0) limits.memory.most_rows = demands.most_coded_rows;
    }
    try {
        const Unlocked unlocked;
        pool_ = std::make_unique<PagePool>(bundles, limits, std::move(demands.blocks));
    } catch (const PageError& error) {
        raise(error);
    }
    on_device_ = work.backend().make_pool(*pool_, tables_, work);
}

BoundPool::~BoundPool() {
    on_device_.reset();
    // Release the GIL, because threads that are ending may wait for it to call Python.
    const Unlocked unlocked;
    pool_.reset();
}

void BoundPool::check_scene(const SceneState& scene) const {
    bool fits = scene.bundles.size() == tables_.size();
    for (size_t b = 0; fits && b < tables_.size(); ++b) fits = tables_[b].is(scene.bundles[b]);
    if (!fits)
        throw py::value_error("scene: expected a scene of the pool's bundles, got other bundles");
}

SettlingStep BoundPool::settle_step(const py::object& scene_object, const BoundEyes& camera,
                                    const SelectRule& rule, bool begins) {
    const auto& scene = held<BoundScene>(scene_object, "scene");
    const std::shared_ptr<const SceneState> state = scene.state();
    check_scene(*state);
    const Work work(device_);
    const Unlocked unlocked;
    return on_device_->settle_step(scene.handle(), *state, camera.eyes, rule, begins, work);
}

void bind_pool(py::module_& m) {
    py::class_<PoolStatus>(
        m, "PoolStatus",
        "The state of a pool: how many pages are resident and how many are missing.")
        .def_readonly("num_slots", &PoolStatus::num_slots)
        .def_readonly("num_resident", &PoolStatus::num_resident)
        .def_readonly("needed", &PoolStatus::needed)
        .def_readonly("missing", &PoolStatus::missing)
        .def_readonly("failed", &PoolStatus::failed)
        .def_readonly("pages_in", &PoolStatus::pages_in)
        .def_readonly("bytes_in", &PoolStatus::bytes_in)
        .def_readonly("least_tolerance_px2", &PoolStatus::least_tolerance_px2)
        .def_readonly("error", &PoolStatus::error)
        .def_readonly("is_damage", &PoolStatus::is_damage);
    py::class_<SettlingStep>(m, "SettlingStep",
                             "The result of one step towards a view whose "
                             "pages are all resident.")
        .def_readonly("tolerance_px2", &SettlingStep::tolerance_px2)
        .def_property_readonly("is_decided",
                               [](const SettlingStep& step) { return step.noted.is_decided; })
        .def_property_readonly("num_absent",
                               [](const SettlingStep& step) { return step.noted.num_absent; });
    py::class_<BoundFileSource>(m, "FileSource", "The file that has the pages of a bundle.")
        .def(py::init([](const std::string& name, int descriptor, const std::string& codec,
                         int sh_degree, const py::array& places, const py::array& hashes,
                         const py::object& fetch) {
                 return BoundFileSource{.name = name,
                                        .descriptor = descriptor,
                                        .codec = codec_of(codec),
                                        .sh_degree = sh_degree,
                                        .places = places,
                                        .hashes = hashes,
                                        .fetch = fetch};
             }),
             py::kw_only(), "name"_a, "descriptor"_a, "codec"_a, "sh_degree"_a, "places"_a,
             "hashes"_a, "fetch"_a = py::none());
    py::class_<BoundPool>(m, "PagePool",
                          "A pool of pages of bundles, in memory of a fixed size on one device.")
        .def(py::init<py::list, py::list, int, size_t, unsigned>(), "tables"_a, "sources"_a,
             "device"_a, "num_bytes"_a, "num_threads"_a)
        .def("settle_step", &BoundPool::settle_step, "scene"_a, "camera"_a, "rule"_a, "begins"_a,
             "Makes all pages resident that were read, and requests the pages that a view needs.")
        .def("status", &BoundPool::status)
        .def("resident", &resident_pages, "bundle"_a,
             "Returns which pages of a bundle are resident: (P,) bool.")
        .def("arrived", &arrived_pages, "bundle"_a,
             "Returns how many frames each page of a bundle has been fading in: (P,) int32, 0 to"
             " 8.")
        .def(
            "raise_tolerance",
            [](BoundPool& p, float from) { return p.pool().raise_tolerance_at_once(from); },
            "from_px2"_a,
            "Raises the smallest tolerance unless the pages of the last view fit. Returns "
            "whether it did.")
        .def(
            "wait", [](BoundPool& p, double seconds) { return p.pool().wait(seconds); },
            "seconds"_a, py::call_guard<Unlocked>(),
            "Waits for pages that were read. Returns whether any can become resident.")
        .def(
            "read_one", [](BoundPool& p) { return p.pool().read_one(); },
            py::call_guard<Unlocked>());
}

}  // namespace v3dg
