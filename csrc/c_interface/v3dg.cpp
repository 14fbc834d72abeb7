// The functions of include/v3dg.h. They check pointers and indices, and convert
// exceptions to status codes.

#include <v3dg.h>

#include <algorithm>
#include <atomic>
#include <new>
#include <system_error>

#include "c_interface/cameras.h"
#include "c_interface/cut.h"
#include "c_interface/fault.h"
#include "c_interface/placing.h"
#include "c_interface/rows.h"
#include "c_interface/scene.h"
#include "c_interface/scene_file.h"

namespace v3dg {

namespace {

constexpr size_t kMostMessageBytes = 2000;

// The message of the last error. It has a fixed size, so that setting it cannot fail.
thread_local char last_error[kMostMessageBytes + 1] = "";

// Sets the message. Control characters, which file names may contain, are replaced by
// "?".
v3dg_status fail(v3dg_status status, const char* text) noexcept {
    size_t size = 0;
    for (; text[size] != '\0' && size < kMostMessageBytes; ++size) {
        const auto byte = static_cast<unsigned char>(text[size]);
        last_error[size] = byte < 0x20 || byte == 0x7f ? '?' : text[size];
    }
    last_error[size] = '\0';
    return status;
}

// Calls body() and returns its status.
template <class Body>
v3dg_status guarded(const Body& body) noexcept {
    try {
        body();
        return V3DG_OK;
    } catch (const Fault& fault) {
        return fail(fault.status, fault.what());
    } catch (const PageError& error) {
        return fail(error.is_damage ? V3DG_ERROR_FILE : V3DG_ERROR_SYSTEM, error.what());
    } catch (const std::system_error& error) {
        return fail(V3DG_ERROR_SYSTEM, error.what());
    } catch (const std::bad_alloc&) {
        return fail(V3DG_ERROR_MEMORY, "memory: expected more, got none; close other scenes");
    } catch (const std::exception& error) {
        return fail(V3DG_ERROR_INTERNAL, error.what());
    } catch (...) {
        return fail(V3DG_ERROR_INTERNAL, "expected no other error");
    }
}

void check_pointer(const void* pointer, const char* name) {
    check_argument(pointer != nullptr, name, "a pointer, got NULL");
}

const OpenBundle& bundle_of(const v3dg_scene* scene, uint32_t bundle) {
    check_pointer(scene, "scene");
    const std::vector<SharedBundle>& bundles = scene->content.bundles;
    check_argument(
        bundle < bundles.size(), "bundle",
        "an index below " + std::to_string(bundles.size()) + ", got " + std::to_string(bundle));
    return *bundles[bundle];
}

const OpenBundle& bundle_with_page(const v3dg_scene* scene, uint32_t bundle, uint32_t page) {
    const OpenBundle& found = bundle_of(scene, bundle);
    check_argument(
        page < found.num_pages(), "page",
        "an index below " + std::to_string(found.num_pages()) + ", got " + std::to_string(page));
    return found;
}

uint64_t new_revision() {
    static std::atomic<uint64_t> last{0};
    return ++last;
}

// Checks the instances, and replaces those of the scene.
void publish(v3dg_scene& scene, std::vector<v3dg_instance> instances) {
    InstanceColumns columns = columns_of(instances);
    scene.content.instances = std::move(instances);
    scene.columns = std::move(columns);
    scene.revision = new_revision();
}

SceneContent read_content(const std::string& path) {
    if (is_scene_name(path)) return read_scene_file(path);
    SceneContent content;
    content.bundles.push_back(std::make_shared<OpenBundle>(path));
    content.instances.push_back(V3DG_DEFAULT_INSTANCE);
    return content;
}

// Checks that all pages above each resident page are resident.
std::vector<int64_t> shifts_of(const OpenBundle& bundle, const uint8_t* is_resident,
                               uint32_t num_pages) {
    check_argument(num_pages == bundle.num_pages(), "num_pages",
                   std::to_string(bundle.num_pages()) + ", got " + std::to_string(num_pages));
    std::vector<int64_t> shift;
    for (uint32_t page = 0; page < num_pages; ++page) {
        const bool is_last = page + 1 == num_pages;
        const int32_t parent = is_last ? -1 : bundle.parent_of_group(page);
        const uint32_t above = parent < 0 ? num_pages - 1 : static_cast<uint32_t>(parent);
        const bool is_here = is_resident[page] != 0;
        check_argument(is_here || !is_last, "is_resident", "the last page, got it as missing");
        check_argument(!is_here || is_resident[above] != 0, "is_resident",
                       "page " + std::to_string(above) + " above page " + std::to_string(page) +
                           ", got it as missing");
        shift.push_back(is_here ? 0 : kAbsentPage);
    }
    return shift;
}

v3dg_page_info page_info(const OpenBundle& bundle, uint32_t page) {
    const PageSource& pages = bundle.pages();
    const bool is_last = page + 1 == bundle.num_pages();
    const int32_t parent = is_last ? -1 : bundle.parent_of_group(page);
    v3dg_page_info info{};
    info.offset = static_cast<uint64_t>(bundle.place(page));
    info.num_bytes = pages.num_bytes(page);
    info.first_gaussian = static_cast<uint64_t>(pages.first_row(page));
    info.num_gaussians = pages.num_rows(page);
    info.first_cluster = static_cast<uint32_t>(pages.first_cluster(page));
    info.num_clusters = static_cast<uint32_t>(pages.num_clusters(page));
    info.parent = parent;
    if (!is_last && parent < 0) info.parent = static_cast<int32_t>(bundle.num_pages() - 1);
    info.level = bundle.level_of_cluster(info.first_cluster);
    return info;
}

v3dg_bundle_info bundle_info(const OpenBundle& bundle) {
    const BundleHeader& header = bundle.header();
    v3dg_bundle_info info{};
    info.num_gaussians = static_cast<uint64_t>(bundle.table().offset[header.num_clusters]);
    info.num_page_bytes = header.pages_bytes();
    for (size_t page = 0; page < bundle.num_pages(); ++page)
        info.most_page_bytes =
            std::max<uint64_t>(info.most_page_bytes, bundle.pages().num_bytes(page));
    info.num_clusters = static_cast<uint32_t>(header.num_clusters);
    info.num_groups = static_cast<uint32_t>(header.num_groups);
    info.num_pages = static_cast<uint32_t>(bundle.num_pages());
    info.num_levels = static_cast<uint32_t>(bundle.num_levels());
    info.sh_degree = header.sh_degree;
    info.is_quantized = header.codec == PageCodec::quantized ? 1 : 0;
    info.version = header.version;
    return info;
}

void read_rows(const OpenBundle& bundle, uint32_t page, const v3dg_gaussians& out) {
    const PageSource& pages = bundle.pages();
    check_room(out, pages.num_rows(page));
    Buffer<unsigned char> bytes(pages.num_bytes(page) + 1);
    pages.read(page, bytes.data());
    std::vector<float> decoded;
    copy_rows(pages.rows(page, bytes.data(), decoded), out, 0);
}

}  // namespace

}  // namespace v3dg

using namespace v3dg;

uint32_t v3dg_abi_version(void) { return V3DG_ABI_VERSION; }

const char* v3dg_last_error(void) { return last_error; }

v3dg_status v3dg_open(const char* path, v3dg_scene** scene) {
    return guarded([&] {
        check_pointer(path, "path");
        check_pointer(scene, "scene");
        auto opened = std::make_unique<v3dg_scene>();
        opened->content = read_content(path);
        opened->page_shift.resize(opened->content.bundles.size());
        publish(*opened, std::move(opened->content.instances));
        *scene = opened.release();
    });
}

v3dg_status v3dg_add_bundle(v3dg_scene* scene, const char* path, uint32_t* bundle) {
    return guarded([&] {
        check_pointer(scene, "scene");
        check_pointer(path, "path");
        check_pointer(bundle, "bundle");
        auto opened = std::make_shared<OpenBundle>(path);
        std::vector<SharedBundle>& bundles = scene->content.bundles;
        bundles.reserve(bundles.size() + 1);
        scene->page_shift.emplace_back();
        bundles.push_back(std::move(opened));
        *bundle = static_cast<uint32_t>(bundles.size() - 1);
    });
}

void v3dg_close(v3dg_scene* scene) { delete scene; }

v3dg_status v3dg_get_scene_info(const v3dg_scene* scene, v3dg_scene_info* info) {
    return guarded([&] {
        check_pointer(scene, "scene");
        check_pointer(info, "info");
        info->num_instances = scene->content.instances.size();
        info->num_bundles = static_cast<uint32_t>(scene->content.bundles.size());
        info->num_cameras = static_cast<uint32_t>(scene->content.cameras.size());
    });
}

v3dg_status v3dg_get_bundle_info(const v3dg_scene* scene, uint32_t bundle, v3dg_bundle_info* info) {
    return guarded([&] {
        const OpenBundle& found = bundle_of(scene, bundle);
        check_pointer(info, "info");
        *info = bundle_info(found);
    });
}

v3dg_status v3dg_get_page_info(const v3dg_scene* scene, uint32_t bundle, uint32_t page,
                               v3dg_page_info* info) {
    return guarded([&] {
        const OpenBundle& found = bundle_with_page(scene, bundle, page);
        check_pointer(info, "info");
        *info = page_info(found, page);
    });
}

v3dg_status v3dg_get_camera(const v3dg_scene* scene, uint32_t index, v3dg_camera* camera,
                            const char** name) {
    return guarded([&] {
        check_pointer(scene, "scene");
        check_pointer(camera, "camera");
        const std::vector<NamedCamera>& cameras = scene->content.cameras;
        check_argument(
            index < cameras.size(), "index",
            "an index below " + std::to_string(cameras.size()) + ", got " + std::to_string(index));
        *camera = cameras[index].camera;
        if (name != nullptr) *name = cameras[index].name.c_str();
    });
}

v3dg_status v3dg_look_at(const double eye[3], const double target[3], const double up[3],
                         double fov_x, int32_t width, int32_t height, double near_depth,
                         v3dg_camera* camera) {
    return guarded([&] {
        check_pointer(eye, "eye");
        check_pointer(target, "target");
        check_pointer(up, "up");
        check_pointer(camera, "camera");
        *camera = camera_looking_at(eye, target, up, fov_x, width, height, near_depth);
    });
}

v3dg_status v3dg_get_instances(const v3dg_scene* scene, v3dg_instance* instances,
                               uint64_t capacity) {
    return guarded([&] {
        check_pointer(scene, "scene");
        const std::vector<v3dg_instance>& all = scene->content.instances;
        check_argument(capacity >= all.size(), "capacity",
                       "room for " + std::to_string(all.size()) + " instances, got " +
                           std::to_string(capacity));
        if (!all.empty()) check_pointer(instances, "instances");
        std::copy(all.begin(), all.end(), instances);
    });
}

v3dg_status v3dg_set_instances(v3dg_scene* scene, const v3dg_instance* instances,
                               uint64_t num_instances) {
    return guarded([&] {
        check_pointer(scene, "scene");
        if (num_instances > 0) check_pointer(instances, "instances");
        check_argument(num_instances <= INT32_MAX, "num_instances",
                       "at most 2147483647, got " + std::to_string(num_instances));
        const size_t num_bundles = scene->content.bundles.size();
        std::vector<v3dg_instance> checked;
        for (uint64_t i = 0; i < num_instances; ++i) {
            const std::string name = "instances[" + std::to_string(i) + "].";
            check_argument(instances[i].bundle < num_bundles, name + "bundle",
                           "an index below " + std::to_string(num_bundles) + ", got " +
                               std::to_string(instances[i].bundle));
            checked.push_back(checked_instance(instances[i], name));
        }
        publish(*scene, std::move(checked));
    });
}

v3dg_status v3dg_set_resident(v3dg_scene* scene, uint32_t bundle, const uint8_t* is_resident,
                              uint32_t num_pages) {
    return guarded([&] {
        const OpenBundle& found = bundle_of(scene, bundle);
        std::vector<int64_t> shift;
        if (is_resident != nullptr) shift = shifts_of(found, is_resident, num_pages);
        scene->page_shift[bundle] = std::move(shift);
    });
}

v3dg_status v3dg_select(const v3dg_scene* scene, const v3dg_camera* eyes, uint32_t num_eyes,
                        const v3dg_rule* rule, v3dg_cut** cut) {
    return guarded([&] {
        check_pointer(scene, "scene");
        check_pointer(cut, "cut");
        const v3dg_rule default_rule = V3DG_DEFAULT_RULE;
        *cut = select_cut(*scene, eyes_of(eyes, num_eyes), rule ? *rule : default_rule);
    });
}

void v3dg_free_cut(v3dg_cut* cut) { free_cut(cut); }

v3dg_status v3dg_read_page(const v3dg_scene* scene, uint32_t bundle, uint32_t page, void* bytes,
                           uint64_t capacity) {
    return guarded([&] {
        const OpenBundle& found = bundle_with_page(scene, bundle, page);
        check_pointer(bytes, "bytes");
        const size_t size = found.pages().num_bytes(page);
        check_argument(
            capacity >= size, "capacity",
            "room for " + std::to_string(size) + " bytes, got " + std::to_string(capacity));
        Buffer<unsigned char> verified(size + 1);
        found.pages().read(page, verified.data());
        std::copy_n(verified.data(), size, static_cast<unsigned char*>(bytes));
    });
}

v3dg_status v3dg_read_gaussians(const v3dg_scene* scene, uint32_t bundle, uint32_t page,
                                const v3dg_gaussians* gaussians) {
    return guarded([&] {
        const OpenBundle& found = bundle_with_page(scene, bundle, page);
        check_pointer(gaussians, "gaussians");
        read_rows(found, page, *gaussians);
    });
}

v3dg_status v3dg_read_cut(const v3dg_scene* scene, const v3dg_cut* cut, const double origin[3],
                          const v3dg_gaussians* gaussians) {
    return guarded([&] {
        check_pointer(scene, "scene");
        check_pointer(cut, "cut");
        check_pointer(gaussians, "gaussians");
        read_cut(*scene, *cut, origin, *gaussians);
    });
}
