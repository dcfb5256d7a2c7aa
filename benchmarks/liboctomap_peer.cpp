// SPDX-License-Identifier: Apache-2.0
// Peer of benchmarks/perception.py: inserts frames with liboctomap and tells what it cost.
// Arguments: frames file, .bt file to write, after how many frames to encode, as a node would (0: never), resolution.
// Prints: ms of insertion, ms of encoding, MB of the tree in the end.
// The file: int32 number of frames; for each: float32 origin[3], int32 n, float32 points[n][3].
#include <octomap/octomap.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <sstream>
#include <vector>

int main(int argc, char** argv) {
  if (argc != 5) return 2;
  std::ifstream in(argv[1], std::ios::binary);
  const int every = std::atoi(argv[3]);
  int32_t frames = 0;
  in.read(reinterpret_cast<char*>(&frames), 4);
  octomap::OcTree tree(std::atof(argv[4]));
  double insertion = 0.0, encoding = 0.0;
  for (int32_t i = 0; i < frames; ++i) {
    float origin[3];
    int32_t n = 0;
    in.read(reinterpret_cast<char*>(origin), sizeof origin);
    in.read(reinterpret_cast<char*>(&n), 4);
    std::vector<float> xyz(3 * static_cast<size_t>(n));
    in.read(reinterpret_cast<char*>(xyz.data()), static_cast<std::streamsize>(xyz.size() * sizeof(float)));
    const std::clock_t begin = std::clock();
    octomap::Pointcloud cloud;
    cloud.reserve(static_cast<size_t>(n));
    for (int32_t k = 0; k < n; ++k) cloud.push_back(xyz[3 * k], xyz[3 * k + 1], xyz[3 * k + 2]);
    tree.insertPointCloud(cloud, octomap::point3d(origin[0], origin[1], origin[2]), -1.0, false, true);
    insertion += static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC;
    if (every > 0 && i % every == every - 1) {
      const std::clock_t start = std::clock();
      std::ostringstream out;
      tree.writeBinaryData(out);
      encoding += static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
    }
  }
  const double memory = static_cast<double>(tree.memoryUsage());  // before writeBinary, which prunes
  tree.writeBinary(argv[2]);
  std::printf("%.3f %.3f %.3f\n", 1e3 * insertion, 1e3 * encoding, 1e-6 * memory);
  return in.good() ? 0 : 1;
}
