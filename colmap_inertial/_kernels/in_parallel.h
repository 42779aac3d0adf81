// Work that threads share.
#pragma once

#include <algorithm>
#include <atomic>
#include <thread>
#include <vector>

// Calls work(i) for 0 <= i < count, every i once.
template <class Work>
void in_parallel(int count, int threads, const Work &work) {
    std::atomic<int> next{0};
    auto loop = [&] {
        for (int i; (i = next.fetch_add(1, std::memory_order_relaxed)) < count;) work(i);
    };
    std::vector<std::thread> others;
    for (int t = 1; t < std::min(threads, count); ++t) others.emplace_back(loop);
    loop();
    for (auto &thread : others) thread.join();
}

inline int mirrored(int index, int size) {
    if (size == 1) return 0;
    const int period = 2 * size - 2;
    index = (index < 0 ? -index : index) % period;
    return std::min(index, period - index);
}
