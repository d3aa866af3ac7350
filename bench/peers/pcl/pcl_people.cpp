// PCL's ground-based people detector over depth images: frames on standard input, JSON lines on standard output.
//
// A frame is a line "STAMP_NS WIDTH HEIGHT FX FY CX CY SCALE" with the 16 numbers of T_world_camera after it, row by
// row, and then WIDTH * HEIGHT 16-bit depths in the machine's byte order.
//
// Everything is PCL's default. There is no colour, so the HOG classifier that would look at it is left out: Debian does
// not ship the SVM it was trained to either. A head's centre is what PCL calls the centre of a person: that of the
// points in the uppermost eighth. The time is that of compute(), without making the cloud from the image.

#include <pcl/console/print.h>
#include <pcl/people/ground_based_people_detection_app.h>
#include <pcl/point_types.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <iostream>
#include <limits>
#include <sstream>
#include <string>
#include <vector>

using Point = pcl::PointXYZRGBA;
using Cloud = pcl::PointCloud<Point>;

struct Camera {
  int width = 0, height = 0;
  float fx = 0, fy = 0, cx = 0, cy = 0, scale = 0;
};

Cloud::Ptr unproject(const Camera& camera, const std::vector<std::uint16_t>& depth) {
  Cloud::Ptr cloud(new Cloud(camera.width, camera.height));
  cloud->is_dense = false;
  for (int v = 0; v < camera.height; ++v)
    for (int u = 0; u < camera.width; ++u) {
      const std::uint16_t value = depth[static_cast<std::size_t>(v) * camera.width + u];
      const float z = value ? camera.scale * value : std::numeric_limits<float>::quiet_NaN();
      Point& point = (*cloud)(u, v);
      point.x = (u - camera.cx) * z / camera.fx;
      point.y = (v - camera.cy) * z / camera.fy;
      point.z = z;
    }
  return cloud;
}

// The rotation that makes the camera level: y straight down, as PCL expects it, z still forward.
Eigen::Matrix3f level(const Eigen::Matrix3f& R_world_camera) {
  const Eigen::Vector3f down = -R_world_camera.row(2).transpose();  // of the world, in the camera's axes
  const Eigen::Vector3f right = down.cross(Eigen::Vector3f::UnitZ()).normalized();
  Eigen::Matrix3f R_level_camera;
  R_level_camera << right.transpose(), down.transpose(), right.cross(down).transpose();
  return R_level_camera;
}

int main() {
  pcl::console::setVerbosityLevel(pcl::console::L_ALWAYS);
  std::string line;
  while (std::getline(std::cin, line)) {
    std::istringstream header(line);
    std::int64_t stamp_ns = 0;
    Camera camera;
    Eigen::Matrix4f T_world_camera;
    header >> stamp_ns >> camera.width >> camera.height >> camera.fx >> camera.fy >> camera.cx >> camera.cy >>
        camera.scale;
    for (int k = 0; k < 16; ++k) header >> T_world_camera(k / 4, k % 4);
    std::vector<std::uint16_t> depth(static_cast<std::size_t>(camera.width) * camera.height);
    std::cin.read(reinterpret_cast<char*>(depth.data()), static_cast<std::streamsize>(2 * depth.size()));
    if (!header || !std::cin) {
      std::cerr << "pcl_people: expected a frame, got: " << line.substr(0, 80) << "\n";
      return 1;
    }

    const Eigen::Matrix3f R = T_world_camera.topLeftCorner<3, 3>();
    Eigen::VectorXf ground(4);  // of the plane z = 0 of the world, in the camera's frame
    ground << R.row(2).transpose(), T_world_camera(2, 3);
    Eigen::Matrix3f intrinsics;
    intrinsics << camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1;
    const Eigen::Matrix3f R_level_camera = level(R);

    pcl::people::GroundBasedPeopleDetectionApp<Point> detector;
    detector.setIntrinsics(intrinsics);
    detector.setGround(ground);
    detector.setTransformation(R_level_camera);
    detector.setClassifier(pcl::people::PersonClassifier<pcl::RGB>());  // untrained: it answers at once
    Cloud::Ptr cloud = unproject(camera, depth);
    std::vector<pcl::people::PersonCluster<Point>> people;
    const auto begun = std::chrono::steady_clock::now();
    detector.setInputCloud(cloud);
    detector.compute(people);
    const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - begun;

    std::printf("{\"stamp_ns\": %lld, \"latency_ms\": %.3f, \"heads\": [", static_cast<long long>(stamp_ns), took.count());
    bool first = true;
    for (auto& person : people) {
      const Eigen::Vector3f in_camera = R_level_camera.transpose() * person.getCenter();
      const Eigen::Vector3f centre = R * in_camera + T_world_camera.topRightCorner<3, 1>();
      std::printf("%s{\"centre\": [%.4f, %.4f, %.4f]}", first ? "" : ", ", centre.x(), centre.y(), centre.z());
      first = false;
    }
    std::printf("]}\n");
    std::fflush(stdout);
  }
  return 0;
}
