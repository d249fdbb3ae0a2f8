"""What a study is made of beside the stages that it runs: which samples there are, what their keys
mean, where they run, how their rows are kept, and what these say together.
"""
