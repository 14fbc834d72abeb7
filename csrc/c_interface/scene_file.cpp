// Reads scenes with the checks and the error texts of the Python reader
// (v3dg/scene/file.py). Each file is read once. The layouts that were published with
// the V3DG paper are not supported.

#include "c_interface/scene_file.h"

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <map>
#include <set>
#include <string>
#include <system_error>
#include <utility>

#include <sys/stat.h>

#include "c_interface/cameras.h"
#include "c_interface/json_node.h"
#include "c_interface/placing.h"
#include "io/file.h"

namespace v3dg {

namespace {

namespace fs = std::filesystem;

constexpr size_t kMostDepth = 16;
constexpr size_t kMostInstances = size_t(1) << 24;
constexpr double kDefaultFov = 0.785398163397448;
constexpr double kDefaultNear = 0.01;

using SharedScene = std::shared_ptr<const SceneContent>;

std::string read_text(const std::string& path) {
    try {
        const v3dg::File file = v3dg::File::open(path.c_str());
        if (!file.is_regular())
            throw Fault(V3DG_ERROR_FILE,
                        path + ": expected a file, got a directory, a device or a pipe");
        std::string text(file.size(), '\0');
        text.resize(file.read_at(0, text.data(), text.size()));
        return text;
    } catch (const std::system_error& error) {
        throw Fault(V3DG_ERROR_SYSTEM, path + ": " + error.code().message());
    }
}

Json parse_file(const std::string& path, const std::string& name) {
    const std::string text = read_text(path);
    const auto fail = [&](const std::string& problem) {
        throw Fault(V3DG_ERROR_FILE,
                    name + ": expected JSON, got a file that does not parse: " + problem);
    };
    if (text.compare(0, 2, "\xff\xfe") == 0 || text.compare(0, 2, "\xfe\xff") == 0)
        fail("the file is in UTF-16; save it as UTF-8");
    try {
        return parse_json(text);
    } catch (const std::invalid_argument& error) {
        fail(error.what());
    }
    return {};
}

bool is_number(const Json& value, int64_t number) {
    const auto* whole = value.get<int64_t>();
    const auto* real = value.get<double>();
    return (whole != nullptr && *whole == number) ||
           (real != nullptr && *real == static_cast<double>(number));
}

std::string real_path(const fs::path& path) { return fs::weakly_canonical(path).string(); }

std::string axis_of(const Node& instance, const Node& up) {
    const std::string axis = up.text();
    return instance.attempt([&] {
        check_argument(is_axis(axis), "up", names_of_axes() + ", got '" + axis + "'");
        return axis;
    });
}

void copy(const std::vector<double>& from, double* to) { std::copy(from.begin(), from.end(), to); }

// Sets position, quaternion and scale.
void read_pose(const Node& node, const Fields& fields, v3dg_instance& out) {
    const auto field = [&](const char* name) {
        const auto found = fields.find(name);
        return found == fields.end() ? nullptr : &found->second;
    };
    if (const Node* matrix = field("matrix")) {
        if (field("position") || field("quaternion") || field("scale"))
            throw node.problem(
                "expected either matrix, or position, quaternion and scale, got both");
        const std::vector<double> values = matrix->matrix(4, 4);
        node.attempt([&] {
            set_similarity(values.data(), out);
            return 0;
        });
        return;
    }
    copy(node.field("position").vector(3), out.position);
    if (const Node* quaternion = field("quaternion")) {
        copy(quaternion->vector(4), out.quaternion);
        if (std::count(out.quaternion, out.quaternion + 4, 0.0) == 4)
            throw quaternion->error("a nonzero quaternion");
    }
    if (const Node* scale = field("scale")) out.scale = scale->positive();
}

// Returns a number that is positive as a float32, or throws.
float positive_float(const Node& node) {
    const double number = node.positive();
    const auto rounded = static_cast<float>(number);
    if (!(rounded > 0 && std::isfinite(rounded)))
        throw node.error("a positive number that a float32 can hold");
    return rounded;
}

// Returns an integer in a range, or throws.
int32_t whole_number(const Node& node, int32_t low, int32_t high) {
    const double number = node.number();
    if (number != std::trunc(number) || number < low || number > high)
        throw node.error("a whole number from " + std::to_string(low) + " to " +
                         std::to_string(high));
    return static_cast<int32_t>(number);
}

void read_factors(const Fields& fields, v3dg_instance& out) {
    const auto field = [&](const char* name) {
        const auto found = fields.find(name);
        return found == fields.end() ? nullptr : &found->second;
    };
    if (const Node* importance = field("importance")) out.importance = positive_float(*importance);
    if (const Node* opacity = field("opacity")) {
        const double number = opacity->number();
        if (!(number >= 0 && number <= 1)) throw opacity->error("a number from 0 to 1");
        out.opacity = static_cast<float>(number);
    }
    if (const Node* tint = field("tint")) {
        const std::vector<double> numbers = tint->vector(3);
        for (int k = 0; k < 3; ++k) {
            out.tint[k] = static_cast<float>(numbers[k]);
            if (numbers[k] < 0 || !std::isfinite(out.tint[k]))
                throw tint->error("3 numbers of at least 0 that a float32 can hold");
        }
    }
    if (const Node* environment = field("environment"))
        out.environment = whole_number(*environment, kSharedEnvironment, kMostEnvironment);
    // Labels are only checked, because cuts do not use them.
    if (const Node* label = field("label")) whole_number(*label, -1, INT32_MAX);
}

int32_t lens_of(const Fields& fields) {
    const auto model = fields.find("model");
    if (model == fields.end()) return V3DG_PINHOLE;
    const std::string name = model->second.text();
    if (name == "PINHOLE") return V3DG_PINHOLE;
    if (name == "OPENCV") return V3DG_OPENCV;
    if (name == "OPENCV_FISHEYE") return V3DG_FISHEYE;
    throw model->second.error("PINHOLE or OPENCV or OPENCV_FISHEYE");
}

void read_lens(const Node& node, const Fields& fields, v3dg_camera& out) {
    std::vector<double> values;
    const auto distortion = fields.find("distortion");
    if (distortion != fields.end()) values = distortion->second.numbers();
    out.lens = lens_of(fields);
    const char* const counts[] = {"0", "4 or 5 or 8", "4"};
    const char* const names[] = {"PINHOLE", "OPENCV", "OPENCV_FISHEYE"};
    const size_t count = values.size();
    const bool fits[] = {count == 0, count == 4 || count == 5 || count == 8, count == 4};
    if (!fits[out.lens])
        node.attempt([&]() -> int {
            throw Fault(V3DG_ERROR_ARGUMENT, std::string("distortion: expected ") +
                                                 counts[out.lens] + " coefficients of " +
                                                 names[out.lens] + ", got " +
                                                 std::to_string(count));
        });
    copy(values, out.distortion);
}

v3dg_camera camera_of_matrices(const Node& node, const Fields& fields) {
    v3dg_camera camera{};
    copy(fields.at("viewmat").matrix(4, 4), camera.viewmat);
    const std::vector<double> K = fields.at("K").matrix(3, 3);
    camera.fx = K[0];
    camera.cx = K[2];
    camera.fy = K[4];
    camera.cy = K[5];
    const bool is_plain = K[1] == 0 && K[3] == 0 && K[6] == 0 && K[7] == 0 && K[8] == 1;
    read_lens(node, fields, camera);
    camera.width = fields.at("width").size();
    camera.height = fields.at("height").size();
    camera.near_depth = fields.count("near") ? fields.at("near").positive() : kDefaultNear;
    node.attempt([&] {
        check_camera(camera);
        check_argument(is_plain, "K",
                       "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got a matrix with skew or scale");
        return 0;
    });
    return camera;
}

v3dg_camera camera_of_points(const Node& node, const Fields& fields) {
    const std::vector<double> eye = fields.at("eye").vector(3);
    const std::vector<double> target = fields.at("target").vector(3);
    std::vector<double> up = {0, 0, 1};
    if (fields.count("up")) up = fields.at("up").vector(3);
    double fov = kDefaultFov;
    if (fields.count("fov_x")) fov = fields.at("fov_x").number("radians between 0 and pi", 0, M_PI);
    const double near_depth = fields.count("near") ? fields.at("near").positive() : kDefaultNear;
    return node.attempt([&] {
        return camera_looking_at(eye.data(), target.data(), up.data(), fov,
                                 fields.at("width").size(), fields.at("height").size(), near_depth);
    });
}

v3dg_camera read_camera(const Node& node, const Fields& fields) {
    const auto has = [&](const char* name) { return fields.count(name) > 0; };
    fields.at("width").size();
    fields.at("height").size();
    const bool has_matrices = has("viewmat") && has("K");
    const bool has_points = has("eye") && has("target");
    if (has_matrices == has_points || (has_matrices && (has("up") || has("fov_x"))))
        throw node.error("either viewmat and K, or eye and target (optionally with up and fov_x)");
    if (has_points && (has("distortion") || has("model")))
        throw node.error("viewmat and K with a model and distortion");
    return has_matrices ? camera_of_matrices(node, fields) : camera_of_points(node, fields);
}

std::vector<NamedCamera> read_cameras(const Node& nodes) {
    std::vector<NamedCamera> cameras;
    std::set<std::string> names;
    nodes.for_each([&](const Node& node) {
        const Fields fields = node.only_fields(
            {"name", "width", "height"},
            {"near", "viewmat", "K", "distortion", "model", "eye", "target", "up", "fov_x"});
        const std::string name = fields.at("name").text();
        if (!names.insert(name).second)
            throw fields.at("name").error("a name that no other camera has");
        cameras.push_back({name, read_camera(node, fields)});
    });
    return cameras;
}

// Adds instances to a scene, and the bundles of the first ones.
class SceneBuilder {
  public:
    SceneContent content;

    void add(const SharedBundle& bundle, const v3dg_instance& instance) {
        const auto [found, is_new] = index_of_.emplace(bundle.get(), content.bundles.size());
        if (is_new) content.bundles.push_back(bundle);
        content.instances.push_back(instance);
        content.instances.back().bundle = static_cast<uint32_t>(found->second);
    }

  private:
    std::map<const OpenBundle*, size_t> index_of_;
};

// The bundles and nested scenes of a file, by name.
struct Subjects {
    std::map<std::string, SharedBundle> bundles;
    std::map<std::string, SharedScene> scenes;
};

class SceneFiles {
  public:
    SceneContent read(const fs::path& path) {
        const std::string name = path.filename().string();
        const Json root = parse_file(path.string(), name);
        chain_.push_back(real_path(path));
        SceneContent content = read_root(Node(root, name, ""), path.parent_path());
        chain_.pop_back();
        return content;
    }

  private:
    SceneContent read_root(const Node& root, const fs::path& folder) {
        if (root.has("layouts") || (root.has("asset") && !root.has("format")))
            throw root.problem(
                "expected a scene, got a layout as published with the V3DG paper; convert it in "
                "Python with v3dg.read_scene and v3dg.write_scene");
        std::vector<std::string> required = {"format", "version", "instances"};
        if (!root.has("scenes")) required.insert(required.begin() + 2, "bundles");
        const Fields top = root.only_fields(required, {"cameras", "up", "bundles", "scenes"});
        const auto* format = top.at("format").value().get<std::string>();
        if (format == nullptr || *format != "v3dg-scene")
            throw top.at("format").error("\"v3dg-scene\"");
        if (!is_number(top.at("version").value(), 1))
            throw top.at("version").error("version 1, the only one that can be read");
        SceneBuilder scene;
        if (top.count("up")) scene.content.up = axis_of(root, top.at("up"));
        const Subjects subjects = subjects_of(top, folder);
        top.at("instances").for_each([&](const Node& node) { add(node, subjects, scene); });
        if (top.count("cameras")) scene.content.cameras = read_cameras(top.at("cameras"));
        return std::move(scene.content);
    }

    Subjects subjects_of(const Fields& top, const fs::path& folder) {
        Subjects subjects;
        if (top.count("bundles"))
            for (const auto& [name, node] : top.at("bundles").fields({}))
                subjects.bundles[name] = bundle(node, folder);
        if (top.count("scenes"))
            for (const auto& [name, node] : top.at("scenes").fields({}))
                subjects.scenes[name] = nested(node, folder);
        return subjects;
    }

    SharedBundle bundle(const Node& node, const fs::path& folder) {
        const fs::path path = folder / node.text();
        std::error_code ignored;
        if (!fs::is_regular_file(path, ignored))
            throw node.problem("expected a bundle at " + path.string() +
                                   ", got no file; build it with `v3dg build`",
                               V3DG_ERROR_SYSTEM);
        SharedBundle& known = bundles_[real_path(path)];
        if (known == nullptr) known = std::make_shared<OpenBundle>(path.string());
        return known;
    }

    SharedScene nested(const Node& node, const fs::path& folder) {
        const fs::path path = folder / node.text();
        const std::string real = real_path(path);
        if (std::find(chain_.begin(), chain_.end(), real) != chain_.end()) {
            std::string names;
            for (const std::string& file : chain_)
                names += fs::path(file).filename().string() + " > ";
            throw node.problem("expected scenes that do not contain themselves, got " + names +
                               path.filename().string());
        }
        if (chain_.size() >= kMostDepth)
            throw node.problem("expected at most 16 nested scenes, got more");
        std::error_code ignored;
        if (!fs::is_regular_file(path, ignored))
            throw node.problem("expected a scene at " + path.string() + ", got none",
                               V3DG_ERROR_SYSTEM);
        if (!is_scene_name(path.string()))
            throw node.error("the name of a scene's file, which ends in .json");
        SharedScene& known = scenes_[real];
        if (known == nullptr) known = std::make_shared<SceneContent>(read(path));
        return known;
    }

    static void add(const Node& node, const Subjects& subjects, SceneBuilder& scene) {
        const Fields fields =
            node.only_fields({}, {"bundle", "scene", "position", "quaternion", "scale", "matrix",
                                  "up", "importance", "opacity", "tint", "environment", "label"});
        if (fields.count("bundle") == fields.count("scene"))
            throw node.error("exactly one of the fields bundle and scene");
        if (!fields.count("matrix")) node.field("position");
        const bool is_nested = fields.count("scene") > 0;
        SharedBundle bundle;
        SharedScene inner;
        if (is_nested)
            inner = named(fields.at("scene"), subjects.scenes, "scenes");
        else
            bundle = named(fields.at("bundle"), subjects.bundles, "bundles");
        v3dg_instance instance = V3DG_DEFAULT_INSTANCE;
        read_pose(node, fields, instance);
        read_factors(fields, instance);
        if (fields.count("up")) {
            const std::string own = is_nested ? scene_axis(*inner) : bundle_axis(*bundle);
            stand_upright(node, fields.at("up"), own, scene.content, instance);
        }
        instance = node.attempt([&] { return checked_instance(instance, ""); });
        if (is_nested)
            add_all(node, *inner, instance, scene);
        else
            scene.add(bundle, instance);
    }

    static std::string bundle_axis(const OpenBundle& bundle) {
        return is_axis(bundle.header().up) ? bundle.header().up : "-y";
    }
    static std::string scene_axis(const SceneContent& scene) {
        return scene.up.empty() ? "z" : scene.up;
    }

    // Rotates the subject from its own up axis to the up axis of the instance. The
    // latter becomes the up axis of the scene.
    static void stand_upright(const Node& node, const Node& up, const std::string& own,
                              SceneContent& scene, v3dg_instance& instance) {
        const std::string axis = axis_of(node, up);
        if (!scene.up.empty() && scene.up != axis)
            throw up.error(scene.up + ", the up axis of the other instances");
        scene.up = axis;
        const double* q = instance.quaternion;
        const Quaternion turned =
            product(normalised({q[0], q[1], q[2], q[3]}), turn_between(own, axis));
        std::copy(turned.begin(), turned.end(), instance.quaternion);
    }

    static void add_all(const Node& node, const SceneContent& inner, const v3dg_instance& outer,
                        SceneBuilder& scene) {
        if (scene.content.instances.size() + inner.instances.size() > kMostInstances)
            throw node.problem(
                "expected at most 16,777,216 instances, including those of nested scenes, got "
                "more");
        for (const v3dg_instance& instance : inner.instances) {
            const v3dg_instance placed =
                node.attempt([&] { return composed(outer, instance, ""); });
            scene.add(inner.bundles[instance.bundle], placed);
        }
    }

    template <class Subject>
    static Subject named(const Node& node, const std::map<std::string, Subject>& subjects,
                         const char* kind) {
        const auto found = subjects.find(node.text());
        if (found == subjects.end()) throw node.error(std::string("a name in ") + kind);
        return found->second;
    }

    std::map<std::string, SharedBundle> bundles_;
    std::map<std::string, SharedScene> scenes_;
    std::vector<std::string> chain_;
};

}  // namespace

bool is_scene_name(const std::string& path) {
    const std::string name = fs::path(path).filename().string();
    const auto ends_in = [&](const std::string& end) {
        return name.size() >= end.size() &&
               name.compare(name.size() - end.size(), end.size(), end) == 0;
    };
    return ends_in(".json") && !ends_in("meta.json");
}

SceneContent read_scene_file(const std::string& path) { return SceneFiles().read(path); }

}  // namespace v3dg
